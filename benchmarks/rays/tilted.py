"""The 3-D LiDAR against embree: random poses in the bore, tilted by up to 20°, beams of a many-beam sensor."""

import dataclasses
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.fidelity.derive.surface import Caster
from benchmarks.rays.agreement import EDGE_JUMP, EDGE_TURN, Agreement
from benchmarks.rays.scenefiles import reference_surface
from subterra_jax import lidar3d
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.tunnel.plan import TunnelPlan

RANGE_MAX, TILT = 30.0, np.deg2rad(20.0)
_ELEVATION = np.deg2rad(25.0)  # highest of a beam over its sensor's plane
_N_BEAMS = 64
_BATCH = 500  # scans
_HEIGHT, _ASIDE = (0.3, 1.5), 0.7  # of sensors above the track, m, and share of the half-width


@dataclasses.dataclass(frozen=True)
class Scans:
    """Poses and beams: `position (n, 3)` m, `orientation (n, 4)` w first, `station (n,)` m, `beam (m, 3)`; float32."""

    position: np.ndarray
    orientation: np.ndarray
    station: np.ndarray
    beam: np.ndarray

    def ways(self, turn: float = 0.0) -> np.ndarray:
        """Directions of all beams, each turned about the sensor's z axis by `turn` rad, `(n·m, 3)`."""
        beam = Rotation.from_euler("z", turn).apply(self.beam.astype(np.float64))
        turns = Rotation.from_quat(self.orientation[:, [1, 2, 3, 0]]).as_matrix()
        return np.einsum("nij,mj->nmi", turns, beam).reshape(-1, 3)


def compare_tilted(folder: Path, plan: TunnelPlan, lining: str, n_rays: int, seed: int) -> tuple[Agreement, float]:
    """Ranges of the 3-D LiDAR in lining, track and furniture against embree; and rays per second of the simulator.

    Args:
        folder: The scene.
        plan: Its planar tunnel, for the height of the track.
        lining: Variant of the walls.
        n_rays: Rays, 64 a scan.
        seed: Of poses and beams.
    """
    scans = random_scans(folder, plan, max(1, n_rays // _N_BEAMS), np.random.default_rng(seed))
    ranges, rate = _simulated(Relief.from_scene(folder, lining), scans)
    surface = reference_surface(folder, lining)
    caster = Caster(trimesh.Trimesh(surface.vertices, surface.faces, process=False))
    origin = np.repeat(scans.position.astype(np.float64), len(scans.beam), axis=0)
    truth, left, right = (
        np.minimum(caster.first(origin, scans.ways(turn))[0], RANGE_MAX) for turn in (0.0, -EDGE_TURN, EDGE_TURN)
    )
    edge = np.maximum(np.abs(left - truth), np.abs(right - truth)) > EDGE_JUMP
    station = np.repeat(scans.station, len(scans.beam))
    return Agreement(f"3-D, {lining}", np.abs(ranges.ravel() - truth), edge, truth, station), rate


def random_scans(folder: Path, plan: TunnelPlan, n: int, rng: np.random.Generator) -> Scans:
    """Tilted sensors anywhere above the track, heading anywhere."""
    with np.load(folder / "bore.npz") as bore:
        grid, axis, lateral = bore["station"], bore["position"], bore["lateral"]
    station = rng.uniform(0.0, grid[-1], n)

    def at(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(station, grid, column) for column in values.T], axis=-1)

    aside = np.interp(station, plan.station, plan.half_width) * _ASIDE * rng.uniform(-1.0, 1.0, n)
    position = at(axis) + aside[:, None] * at(lateral)
    position[:, 2] = np.interp(station, plan.station, plan.elevation) + rng.uniform(*_HEIGHT, n)
    angles = np.column_stack([rng.uniform(-np.pi, np.pi, n), *rng.uniform(-TILT, TILT, (2, n))])
    orientation = Rotation.from_euler("ZYX", angles).as_quat()[:, [3, 0, 1, 2]]
    azimuth, elevation = rng.uniform(-np.pi, np.pi, _N_BEAMS), rng.uniform(-_ELEVATION, _ELEVATION, _N_BEAMS)
    level = np.cos(elevation)
    beam = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
    return Scans(*(values.astype(np.float32) for values in (position, orientation, station, beam)))


def _simulated(relief: Relief, scans: Scans) -> tuple[np.ndarray, float]:
    """Ranges, and rays per second of the median batch, compilation left out."""
    beam = jnp.asarray(scans.beam)

    @jax.jit
    def scan(relief: Relief, position: jax.Array, orientation: jax.Array, station: jax.Array) -> jax.Array:
        one = jax.vmap(lidar3d.scan, in_axes=(None, 0, 0, 0, None, None))
        return one(relief, position, orientation, station, beam, RANGE_MAX)

    n, ranges, seconds = len(scans.station), [], []
    size = min(n, _BATCH)
    for first in range(0, n, size):
        # The last batch overlaps the one before, so that all have one shape.
        rows = slice(min(first, n - size), min(first, n - size) + size)
        inputs = (scans.position[rows], scans.orientation[rows], scans.station[rows])
        if first == 0:
            scan(relief, *inputs).block_until_ready()
        started = time.perf_counter()
        part = np.asarray(scan(relief, *inputs))
        seconds.append(time.perf_counter() - started)
        ranges.append(part[first - rows.start :])
    return np.concatenate(ranges).astype(np.float64), size * _N_BEAMS / float(np.median(seconds))
