"""Draws what each named LiDAR sees from one place: ranges by azimuth and elevation.

`python -m benchmarks.rays.picture --out docs/sensors.png`
"""

import dataclasses
import sys
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

import subterra_jax as st
from benchmarks.command import BenchmarkError, require_least, run_main
from benchmarks.results import png_bytes, write_file
from subterra_jax.parts.spatial_lidar import SENSORS

_TASK = "Subterra/TraverseShort-v1"
_FAR = 12.0  # m, where the colours end
_DOTS = 4_000  # beams of a sensor without rows that are drawn


@dataclasses.dataclass(frozen=True)
class PictureConfig:
    """Settings."""

    out: Path  # The picture, `.png`.
    tunnel: str = "metro"  # Name or file of a tunnel.
    lining: str = "pockets"  # Variant of its walls.
    station: float = 40.0  # Place of the robot, m.
    seed: int = 0  # Seed of the noise.


def main(config: PictureConfig) -> None:
    """Casts and draws.

    Raises:
        SubterraError: A setting is wrong, there is no such tunnel or lining, or the file cannot be written.
    """
    require_least(config, seed=0)
    if config.out.suffix != ".png":
        raise BenchmarkError(f"{config.out}: a picture ends in .png")
    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    axes = figure.subplots(len(SENSORS), 1)
    for axis, name in zip(axes, SENSORS, strict=True):
        azimuth, elevation, ranges = look(config, name)
        mesh = draw(axis, azimuth, elevation, ranges)
        axis.set_title(f"{name}: {ranges.size:,} beams a scan", loc="left", fontsize=9)
    axes[-1].set_xlabel("azimuth, left of ahead, °")
    figure.supylabel("elevation, °", fontsize=9)
    figure.colorbar(mesh, ax=axes, label=f"range, m (beyond {_FAR:g} m one colour)", shrink=0.6)
    write_file(config.out, png_bytes(figure, 110))
    print(config.out)


def look(config: PictureConfig, sensor: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns azimuth and elevation (°) and range (m) of each beam, in the rows of the sensor's image."""
    env, params = st.make(_TASK, tunnel=config.tunnel, lining=config.lining, sensor=sensor)
    start = dataclasses.replace(params.start, station=jax.numpy.float32(config.station))
    observation, _ = jax.jit(env.reset)(jax.random.key(config.seed), params.replace(start=start))
    part = {name: np.asarray(observation[where]) for name, where in env.fields(params).items()}
    if "scan" not in part:
        bearing = np.degrees(st.lidar.bearings(len(part["ranges"])) + np.pi) % 360.0 - 180.0
        return bearing, np.zeros_like(bearing), part["ranges"]
    x, y, z = np.asarray(params.lidar.directions).T
    shape = params.lidar.shape
    azimuth, elevation = np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(np.clip(z, -1.0, 1.0)))
    return azimuth.reshape(shape), elevation.reshape(shape), part["scan"].reshape(shape)


def draw(axis: Axes, azimuth: np.ndarray, elevation: np.ndarray, ranges: np.ndarray) -> PathCollection:
    """Draws beams as dots whose colours are ranges; returns what a colour bar needs."""
    chosen = slice(None, None, max(1, ranges.size // _DOTS)) if ranges.shape[0] == 1 else slice(None)
    size = 40.0 if ranges.size < 100 else 2.0 if ranges.size < 5_000 else 0.3
    x, y, far = (np.ravel(one)[chosen] for one in (azimuth, elevation, ranges))
    axis.set_facecolor("#222222")
    axis.set(xlim=(180, -180), ylim=(-45, 45) if ranges.shape[0] == 1 and ranges.size > 100 else (-25, 25))
    axis.set_xticks(np.arange(-180, 181, 45))
    return axis.scatter(x, y, c=far, s=size, vmin=0.0, vmax=_FAR, cmap=plt.get_cmap("viridis_r"), lw=0)


def command(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("rays.picture", PictureConfig, main, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(command())
