"""Compares ranges of both LiDARs with rays that embree casts in the built mesh of a scene folder."""

import dataclasses
import itertools
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from benchmarks.command import BenchmarkError
from benchmarks.fidelity.derive.surface import Caster
from benchmarks.rays import planar as reference
from scene.bore import load_bore
from subterra_jax import lidar, lidar3d
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.lidar3d.surface import SMALL, Triangles, join_surfaces, read_mesh, read_scene
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan

DEFAULT_SCENE = Path("build/subterra-351")
_WHOLE_MESHES = {"smooth": "lining_smooth.ply", "pockets": "lining.ply"}
_LINING_PARTS = ("lining", "recess", "floor")


def require_scene(folder: Path) -> Path:
    """Returns the folder if it holds a built scene.

    Raises:
        BenchmarkError: A file of a scene is missing.
    """
    for name in ("tunnel.npz", "bore.npz", "scene.xml", "meshes/lining.ply"):
        if not (folder / name).is_file():
            raise BenchmarkError(f"{folder}: is no built scene: {name} is missing (`python -m scene.build` makes one)")
    return folder


def meshed_linings(folder: Path, plan: TunnelPlan) -> list[str]:
    """Returns the linings of a plan that have a mesh in the folder."""
    meshed = {name: (folder / "meshes" / file).is_file() for name, file in _WHOLE_MESHES.items()}
    meshed["furnished"] = (folder / "scene_furnished.xml").is_file()
    return [name for name in plan.linings if meshed.get(name, False)]


def reference_surface(folder: Path, lining: str) -> Triangles:
    """Returns the mesh for embree: the walls of one lining and all else in the scene but bolts and clips."""
    if lining not in _WHOLE_MESHES:
        return read_scene(folder, lining)
    walls = read_mesh(folder / "meshes" / _WHOLE_MESHES[lining])
    return join_surfaces([walls, read_scene(folder, "pockets", (*SMALL, *_LINING_PARTS))])


# Goals: half of all rays within the first, 99.9 % within the second, m.
MEDIAN_GOAL, TAIL_GOAL, TAIL_SHARE = 1e-3, 1e-2, 0.999
# The same of the 3-D LiDAR, which meets the mesh's own triangles.
TILTED_MEDIAN_GOAL, TILTED_TAIL_GOAL = 1e-4, 1e-3
# A ray passes an edge where the reference's own range changes by more than this (m) as the ray turns by that (rad).
EDGE_JUMP, EDGE_TURN = 0.05, 1e-4
_PERCENTILES = (50.0, 90.0, 99.0, 99.9)
_WORST = 10


@dataclasses.dataclass(frozen=True)
class Agreement:
    """One comparison of ranges with those of a reference."""

    title: str  # The two things compared
    error: Float[np.ndarray, "k"]  # Absolute differences, m, `(k,)`
    edge: Bool[np.ndarray, "k"]  # True for rays that pass an edge, `(k,)`
    range: Float[np.ndarray, "k"]  # Ranges of the reference, m, `(k,)`
    station: Float[np.ndarray, "k"]  # Station of the LiDAR, m, `(k,)`
    judged: bool = True  # True where the goals apply
    median_goal: float = MEDIAN_GOAL  # Half of all rays must be within this, m
    tail_goal: float = TAIL_GOAL  # 99.9 % must be within this, m

    @property
    def holds(self) -> bool:
        """True if all rays, edges included, meet the goals, and where the goals do not apply."""
        met = np.median(self.error) < self.median_goal and np.mean(self.error < self.tail_goal) >= TAIL_SHARE
        return bool(met) or not self.judged

    def figures(self) -> dict[str, Any]:
        """Returns the numbers for the report, m; the worst rays are those that pass no edge."""
        plain = np.flatnonzero(~self.edge)
        worst = plain[np.argsort(-self.error[plain], kind="stable")[:_WORST]]
        return {
            "title": self.title,
            "judged": self.judged,
            "holds": self.holds,
            "n_rays": len(self.error),
            "n_edge": int(self.edge.sum()),
            "all": _percentiles(self.error),
            "without_edges": _percentiles(self.error[plain]),
            "worst": [
                {"station": float(self.station[k]), "range": float(self.range[k]), "error": float(self.error[k])}
                for k in worst
            ],
        }


def _percentiles(error: Float[np.ndarray, "k"]) -> dict[str, float]:
    if not len(error):
        return {}
    named = {f"p{q:g}": float(value) for q, value in zip(_PERCENTILES, np.percentile(error, _PERCENTILES), strict=True)}
    within = {"within_1mm": float(np.mean(error < TILTED_TAIL_GOAL)), "within_1cm": float(np.mean(error < TAIL_GOAL))}
    return {**named, "max": float(error.max()), **within}


def compare_planar(folder: Path, plan: TunnelPlan, lining: str, n_rays: int, seed: int) -> list[Agreement]:
    """Compares the planar LiDAR at random poses with the levelled mesh, and with the mesh as it is.

    The planar tunnel is cut at a constant height above the track, so its plane follows the grade. The mesh is levelled
    likewise: each vertex is lowered by the elevation of the track at its station. Straight rays of a pitched LiDAR in
    the mesh as it is are what a real LiDAR on the track measures: they show the cost of the planar model.

    Args:
        folder: Scene folder.
        plan: Its planar tunnel.
        lining: Variant of the walls.
        n_rays: Number of rays, 16 in a scan.
        seed: Seed for the poses.
    """
    params = lidar.LidarParams()
    poses = reference.random_poses(plan, max(1, n_rays // params.n_beams), np.random.default_rng(seed))
    ranges = reference.simulate(Tunnel.from_plan(plan, lining), poses, params).astype(np.float64)
    surface = reference_surface(folder, lining)
    station = load_bore(folder / "bore.npz").axis.local(surface.vertices)[0]
    level = surface.vertices.copy()
    level[:, 2] -= np.interp(station, plan.station, plan.elevation)
    flat, straight = (Caster(trimesh.Trimesh(v, surface.faces, process=False)) for v in (level, surface.vertices))
    elevation = np.interp(poses.station, plan.station, plan.elevation)
    grade = np.interp(poses.station, plan.station, np.gradient(plan.elevation, plan.station))
    height = np.full(len(grade), plan.lidar_height)
    cast_level = partial(_cast, flat, plan, poses, height, np.zeros_like(grade), params)
    cast_pitched = partial(_cast, straight, plan, poses, elevation + height, grade, params)
    title = f"planar, {lining}"
    return [
        _agreement(f"{title}, levelled mesh", cast_level, ranges, poses),
        _agreement(f"{title}, straight rays of a pitched LiDAR", cast_pitched, ranges, poses, judged=False),
    ]


def _cast(
    caster: Caster,
    plan: TunnelPlan,
    poses: reference.Poses,
    height: np.ndarray,
    grade: np.ndarray,
    params: lidar.LidarParams,
    turn: float = 0.0,
) -> np.ndarray:
    """Returns embree's ranges, m, with every beam turned by `turn` rad."""
    angle = poses.heading.astype(np.float64)[:, None] + lidar.bearings(params.n_beams) + turn
    tangent = np.stack([np.interp(poses.station, plan.station, plan.tangent[:, i]) for i in range(2)], axis=-1)
    along = np.cos(angle) * tangent[:, :1] + np.sin(angle) * tangent[:, 1:]
    way = np.stack([np.cos(angle), np.sin(angle), along * grade[:, None]], axis=-1).reshape(-1, 3)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    origin = np.column_stack([poses.position.astype(np.float64), height])
    reach = caster.first(np.repeat(origin, params.n_beams, axis=0), way)[0]
    return np.minimum(reach, params.range_max).reshape(angle.shape)


def _agreement(
    title: str, cast: Callable[..., np.ndarray], ranges: np.ndarray, poses: reference.Poses, judged: bool = True
) -> Agreement:
    truth = cast()
    jump = np.max([np.abs(cast(turn=turn) - truth) for turn in (-EDGE_TURN, EDGE_TURN)], axis=0)
    station = np.repeat(poses.station, ranges.shape[1])
    error, edge = np.abs(ranges - truth).ravel(), (jump > EDGE_JUMP).ravel()
    return Agreement(title, error, edge, truth.ravel(), station, judged)


RANGE_MAX = 30.0  # m, of the 3-D LiDAR
TILT = np.deg2rad(20.0)  # largest roll and pitch of its sensor
_ELEVATION = np.deg2rad(25.0)  # largest elevation of a beam over its sensor's plane
_N_BEAMS = 64  # beams in a 3-D scan
_TILTED_BATCH = 500  # scans in a call
_HEIGHT = (0.3, 1.5)  # m of sensors above the track
_ASIDE = 0.7  # largest lateral offset of a sensor, share of the half-width


@dataclasses.dataclass(frozen=True)
class Scans:
    """Poses and beams, float32."""

    position: np.ndarray  # Sensor positions, m, `(n, 3)`
    orientation: np.ndarray  # Quaternions, w first, `(n, 4)`
    station: np.ndarray  # Stations of the sensors, m, `(n,)`
    beam: np.ndarray  # Unit vectors of the beams in the sensor frame, `(m, 3)`

    def directions(self, axis: str = "z", turn: float = 0.0) -> np.ndarray:
        """Returns the directions of all beams, each turned about an axis of the sensor by `turn` rad, `(n·m, 3)`."""
        beam = Rotation.from_euler(axis, turn).apply(self.beam.astype(np.float64))
        turns = Rotation.from_quat(self.orientation[:, [1, 2, 3, 0]]).as_matrix()
        return np.einsum("nij,mj->nmi", turns, beam).reshape(-1, 3)


def compare_tilted(folder: Path, plan: TunnelPlan, lining: str, n_rays: int, seed: int) -> tuple[Agreement, float]:
    """Compares the 3-D LiDAR in lining, track and furniture with embree; returns rays per second as well.

    Args:
        folder: Scene folder.
        plan: Its planar tunnel, for the height of the track.
        lining: Variant of the walls.
        n_rays: Number of rays, 64 in a scan.
        seed: Seed for poses and beams.
    """
    scans = random_scans(folder, plan, max(1, n_rays // _N_BEAMS), np.random.default_rng(seed))
    ranges, rate = _simulate_tilted(Relief.from_scene(folder, lining), scans)
    surface = reference_surface(folder, lining)
    caster = Caster(trimesh.Trimesh(surface.vertices, surface.faces, process=False))
    origin = np.repeat(scans.position.astype(np.float64), len(scans.beam), axis=0)

    def cast(axis: str = "z", turn: float = 0.0) -> np.ndarray:
        return np.minimum(caster.first(origin, scans.directions(axis, turn))[0], RANGE_MAX)

    truth = cast()
    edge = np.zeros(len(truth), bool)
    for axis, turn in itertools.product("xyz", (-EDGE_TURN, EDGE_TURN)):
        edge |= np.abs(cast(axis, turn) - truth) > EDGE_JUMP
    station = np.repeat(scans.station, len(scans.beam))
    error, goals = np.abs(ranges.ravel() - truth), (TILTED_MEDIAN_GOAL, TILTED_TAIL_GOAL)
    return Agreement(f"3-D, {lining}", error, edge, truth, station, True, *goals), rate


def random_scans(folder: Path, plan: TunnelPlan, n: int, rng: np.random.Generator) -> Scans:
    """Draws tilted sensors anywhere above the track, with any heading."""
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


def _simulate_tilted(relief: Relief, scans: Scans) -> tuple[np.ndarray, float]:
    """Returns ranges, m, and rays per second of the median batch without compilation."""
    beam = jnp.asarray(scans.beam)

    @jax.jit
    def scan(relief: Relief, position: jax.Array, orientation: jax.Array, station: jax.Array) -> jax.Array:
        one = jax.vmap(lidar3d.scan, in_axes=(None, 0, 0, 0, None, None))
        return one(relief, position, orientation, station, beam, RANGE_MAX)

    n, ranges, seconds = len(scans.station), [], []
    size = min(n, _TILTED_BATCH)
    for first in range(0, n, size):
        # The last batch overlaps the one before, so that all have the same shape.
        rows = slice(min(first, n - size), min(first, n - size) + size)
        inputs = (scans.position[rows], scans.orientation[rows], scans.station[rows])
        if first == 0:
            scan(relief, *inputs).block_until_ready()
        started = time.perf_counter()
        part = np.asarray(scan(relief, *inputs))
        seconds.append(time.perf_counter() - started)
        ranges.append(part[first - rows.start :])
    return np.concatenate(ranges).astype(np.float64), size * _N_BEAMS / float(np.median(seconds))
