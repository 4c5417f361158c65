"""Casts the same rays by this library, embree, MuJoCo's `mj_multiRay` and a Warp BVH, all on the CPU.

`python -m benchmarks.rays.peers --scene build/subterra-351 --robots 64`

Warp is optional (`pip install warp-lang`); without it its row is left out. Rates are of one core's time, so that
threads do not count.
"""

import dataclasses
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import trimesh
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from benchmarks.command import require_least, run_main
from benchmarks.fidelity.derive.surface import Caster
from benchmarks.rays.casting import DEFAULT_SCENE, RANGE_MAX, Scans, random_scans, reference_surface, require_scene
from subterra_jax import lidar3d
from subterra_jax.lidar3d import beams
from subterra_jax.lidar3d.surface import SCENES, SMALL, Triangles
from subterra_jax.tunnel.sources import load_tunnel

_SEEN_GROUPS = np.array([1, 1, 0, 0, 0, 0], np.uint8)  # geoms that a camera sees
_UNSEEN_GROUP = 5

Cast = Callable[[], np.ndarray]


@dataclasses.dataclass(frozen=True)
class PeersConfig:
    """Settings. Robots stand anywhere above the track, tilted by up to 20°.

    Attributes:
        scene: Folder of a built scene.
        lining: Variant of its walls.
        robots: Robots, with 16 beams over ± 15° × 64 azimuths each.
        repeats: Timed casts of each peer.
        seed: Seed for the poses.
    """

    scene: Path = DEFAULT_SCENE
    lining: str = "pockets"
    robots: int = 64
    repeats: int = 5
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Row:
    """Results of one peer.

    Attributes:
        name: Name of the peer with its version.
        rates: Rays per second of one core's time, one for each repeat, 1/s.
        error: Absolute differences from float64 on the triangle that embree finds, m, `(n,)`.
        n_bytes: Memory of its surface, bytes.
    """

    name: str
    rates: Float[np.ndarray, "k"]
    error: Float[np.ndarray, "n"]
    n_bytes: int


def resident_memory() -> int:
    """Returns the memory of this process, bytes; 0 where the system does not tell."""
    try:
        status = Path("/proc/self/statm").read_text()
    except OSError:
        return 0
    return int(status.split()[1]) * 4096


def build_ours(folder: Path, lining: str, scans: Scans, surface: Triangles) -> tuple[str, Cast, int]:
    """Returns our cast, from poses to ranges."""
    relief = lidar3d.Relief.from_scene(folder, lining)
    scan = jax.jit(jax.vmap(lidar3d.scan, in_axes=(None, 0, 0, 0, None, None)))
    inputs = relief, *jax.device_put((scans.position, scans.orientation, scans.station)), jnp.asarray(scans.beam)
    return "lidar3d.scan", lambda: np.asarray(scan(*inputs, RANGE_MAX)), relief.n_bytes


def build_embree(folder: Path, lining: str, scans: Scans, surface: Triangles) -> tuple[str, Cast, int]:
    """Returns embree's cast, one ray after another."""
    before = resident_memory()
    scene = rtcore_scene.EmbreeScene()
    # Its numbers are float32 from the origin of the mesh.
    mesh = TriangleMesh(scene, surface.vertices[surface.faces].astype(np.float32))
    origin = np.repeat(scans.position, len(scans.beam), axis=0)
    direction = scans.directions().astype(np.float32)
    scene.run(origin[:1], direction[:1], query="DISTANCE")  # builds the tree
    used = resident_memory() - before

    def cast() -> np.ndarray:
        # The mesh must live as long as its scene.
        return np.asarray(scene.run(origin, direction, query="DISTANCE")) if mesh is not None else origin

    return "embree (embreex)", cast, used


def build_mujoco(folder: Path, lining: str, scans: Scans, surface: Triangles) -> tuple[str, Cast, int]:
    """Returns the cast of MuJoCo's own engine in the scene's MJCF."""
    model = mujoco.MjModel.from_xml_path(str(folder / SCENES[lining]))
    for geom in range(model.ngeom):
        if model.geom(geom).name.split("_")[0] in SMALL:
            model.geom_group[geom] = _UNSEEN_GROUP
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    n_beams = len(scans.beam)
    direction = scans.directions().reshape(len(scans.station), -1)
    geoms, reach = np.zeros(n_beams, np.int32), np.zeros(n_beams)

    def cast() -> np.ndarray:
        ranges = np.empty((len(scans.station), n_beams))
        for row, place, way in zip(ranges, scans.position.astype(np.float64), direction, strict=True):
            mujoco.mj_multiRay(
                model, data, place, way, _SEEN_GROUPS, True, -1, geoms, reach, None, n_beams, RANGE_MAX
            )  # fmt: skip
            row[:] = np.where(reach < 0.0, RANGE_MAX, reach)
        return ranges

    return f"MuJoCo {mujoco.__version__} mj_multiRay", cast, int(model.nbuffer)


def build_warp(folder: Path, lining: str, scans: Scans, surface: Triangles) -> tuple[str, Cast, int]:
    """Returns the cast of Warp's mesh query on the CPU.

    Raises:
        ImportError: Warp is not installed.
    """
    import warp as wp

    wp.config.quiet = True
    before = resident_memory()
    mesh = wp.Mesh(
        wp.array(surface.vertices.astype(np.float32), dtype=wp.vec3, device="cpu"),
        wp.array(surface.faces.astype(np.int32).ravel(), dtype=wp.int32, device="cpu"),
    )
    used = resident_memory() - before

    vectors, numbers = wp.array(dtype=wp.vec3), wp.array(dtype=wp.float32)

    def cast_ray(mesh, origin, way, out):
        ray = wp.tid()
        query = wp.mesh_query_ray(mesh, origin[ray], way[ray], 30.0)
        out[ray] = wp.where(query.result, query.t, 30.0)

    # Warp's types of arrays are calls, which no type checker takes for types.
    cast_ray.__annotations__ = {"mesh": wp.uint64, "origin": vectors, "way": vectors, "out": numbers}
    kernel = wp.kernel(cast_ray)

    origin = np.repeat(scans.position, len(scans.beam), axis=0)
    rows = [wp.array(values.astype(np.float32), dtype=wp.vec3, device="cpu") for values in (origin, scans.directions())]
    out = wp.empty(len(origin), dtype=wp.float32, device="cpu")

    def cast() -> np.ndarray:
        wp.launch(kernel, dim=len(origin), inputs=[mesh.id, *rows, out], device="cpu")
        return np.asarray(out.numpy())

    return f"Warp {wp.__version__} mesh_query_ray", cast, used


PEERS = (build_ours, build_embree, build_mujoco, build_warp)


def measure(config: PeersConfig) -> Iterator[Row]:
    """Casts the rays by each peer.

    Raises:
        SubterraError: A setting is too small, or the folder lacks a scene or the lining.
    """
    require_least(config, robots=1, repeats=1, seed=0)
    folder = require_scene(config.scene)
    plan = load_tunnel(folder / "tunnel.npz")
    beam = beams.spinning(np.deg2rad(np.linspace(-15.0, 15.0, 16)), 64).astype(np.float32)
    poses = random_scans(folder, plan, config.robots, np.random.default_rng(config.seed))
    scans = dataclasses.replace(poses, beam=beam)
    surface = reference_surface(folder, config.lining)
    caster = Caster(trimesh.Trimesh(surface.vertices, surface.faces, process=False))
    origin = np.repeat(scans.position.astype(np.float64), len(beam), axis=0)
    truth = np.minimum(caster.first(origin, scans.directions())[0], RANGE_MAX)
    for build in PEERS:
        try:
            name, cast, n_bytes = build(folder, config.lining, scans, surface)
        except ImportError:
            continue
        error = np.abs(np.minimum(cast().ravel(), RANGE_MAX) - truth)
        seconds = []
        for _ in range(config.repeats):
            started = time.process_time()
            cast()
            seconds.append(time.process_time() - started)
        yield Row(name, len(truth) / np.array(seconds), error, n_bytes)


def table(rows: list[Row]) -> Table:
    """Returns the table of rates, differences and memory."""
    shown = Table(title="the same rays on a CPU")
    for name in ("peer", "M rays/s a core (quartiles)", "median, µm", "99.9 %, mm", "within 1 mm", "MB"):
        shown.add_column(name, justify="left" if name == "peer" else "right")
    for row in rows:
        slow, middle, fast = np.percentile(row.rates, [25, 50, 75]) / 1e6
        median, tail = np.percentile(row.error, [50.0, 99.9])
        shown.add_row(
            row.name, f"{middle:.3g} ({slow:.3g} to {fast:.3g})", f"{1e6 * median:.3g}", f"{1e3 * tail:.3g}",
            f"{100 * np.mean(row.error <= 1e-3):.4f} %", f"{row.n_bytes / 1e6:.1f}",
        )  # fmt: skip
    return shown


def main(config: PeersConfig) -> None:
    """Measures all peers and prints the table."""
    Console(width=130).print(table(list(measure(config))))


def command(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("rays.peers", PeersConfig, main, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(command())
