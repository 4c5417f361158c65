"""Measures the speed of the 3-D LiDAR in a batch of robots, from pose to range.

`python -m benchmarks.rays.speed --scene build/subterra-351 --robots 4096`
"""

import dataclasses
import sys
import time
from pathlib import Path

import jax
import numpy as np

from benchmarks.command import require_least, run_main
from benchmarks.rays.casting import DEFAULT_SCENE, RANGE_MAX, random_scans, require_scene
from subterra_jax import lidar3d
from subterra_jax.lidar3d import beams
from subterra_jax.tunnel.sources import load_tunnel


@dataclasses.dataclass(frozen=True)
class SpeedConfig:
    """Settings. Robots stand anywhere above the track, tilted by up to 20°.

    Attributes:
        scene: Folder of a built scene.
        lining: Variant of its walls.
        robots: Robots.
        rings: Beams of each over ± 15°.
        columns: Azimuths of a turn.
        repeats: Timed calls.
        seed: Seed for the poses.
    """

    scene: Path = DEFAULT_SCENE
    lining: str = "pockets"
    robots: int = 4096
    rings: int = 16
    columns: int = 64
    repeats: int = 20
    seed: int = 0


def main(config: SpeedConfig) -> None:
    """Measures and prints rays per second with quartiles, and the memory of the surface.

    Raises:
        SubterraError: A setting is too small, or the folder lacks a scene or the lining.
    """
    require_least(config, robots=1, rings=1, columns=1, repeats=1, seed=0)
    folder = require_scene(config.scene)
    relief = lidar3d.Relief.from_scene(folder, config.lining)
    poses = random_scans(folder, load_tunnel(folder / "tunnel.npz"), config.robots, np.random.default_rng(config.seed))
    beam = beams.spinning(np.deg2rad(np.linspace(-15.0, 15.0, config.rings)), config.columns)
    beam, n_beams = beam.reshape(config.rings, config.columns, 3), len(beam)
    scan = jax.jit(jax.vmap(lidar3d.scan, in_axes=(None, 0, 0, 0, None, None)))
    inputs = relief, *jax.device_put((poses.position, poses.orientation, poses.station)), beam, RANGE_MAX
    scan(*inputs).block_until_ready()
    seconds = []
    for _ in range(config.repeats):
        started = time.perf_counter()
        scan(*inputs).block_until_ready()
        seconds.append(time.perf_counter() - started)
    slow, middle, fast = (config.robots * n_beams / np.percentile(seconds, [75, 50, 25])) / 1e6
    print(
        f"{config.robots} robots x {n_beams} beams: {middle:.4g} M rays/s ({slow:.4g} to {fast:.4g}), "
        f"surface {relief.n_bytes / 1e6:.1f} MB, {jax.devices()[0].device_kind}"
    )


def command(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("rays.speed", SpeedConfig, main, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(command())
