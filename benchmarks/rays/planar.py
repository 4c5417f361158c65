"""The planar LiDAR against embree in the built mesh, at LiDAR height.

The plane that the planar tunnel is cut in keeps its height above the track, so it follows the grade: the mesh is
levelled the same way, each vertex lowered by the elevation of the track at its station. Straight rays of a pitched
LiDAR are what a real one measures that stands on the track, in the mesh as it is: they tell what the plane costs.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import numpy as np
import trimesh

from benchmarks.fidelity.derive.surface import Caster
from benchmarks.rays.agreement import EDGE_JUMP, EDGE_TURN, Agreement
from benchmarks.rays.scenefiles import reference_surface
from scene.bore import load_bore
from subterra_jax import lidar
from subterra_jax.lidar import reference
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan

_BATCH = 1000


def compare_planar(folder: Path, plan: TunnelPlan, lining: str, n_rays: int, seed: int) -> list[Agreement]:
    """Ranges of the simulator from random poses, against the levelled mesh and against the mesh as it is.

    Args:
        folder: The scene.
        plan: Its planar tunnel.
        lining: Variant of the walls.
        n_rays: Rays, 16 a scan.
        seed: Of the poses.
    """
    params = lidar.LidarParams()
    poses = reference.random_poses(plan, max(1, n_rays // params.n_beams), np.random.default_rng(seed))
    ranges = _simulated(plan, lining, poses, params)
    surface = reference_surface(folder, lining)
    station = load_bore(folder / "bore.npz").axis.local(surface.vertices)[0]
    level = surface.vertices.copy()
    level[:, 2] -= np.interp(station, plan.station, plan.elevation)
    flat, straight = (Caster(trimesh.Trimesh(v, surface.faces, process=False)) for v in (level, surface.vertices))
    elevation = np.interp(poses.station, plan.station, plan.elevation)
    grade = np.interp(poses.station, plan.station, np.gradient(plan.elevation, plan.station))
    no_grade, height = np.zeros_like(grade), np.full(len(grade), plan.lidar_height)
    title = f"planar, {lining}"
    return [
        _agreement(
            f"{title}, levelled mesh", partial(_cast, flat, plan, poses, height, no_grade, params), ranges, poses
        ),
        _agreement(
            f"{title}, straight rays of a pitched LiDAR",
            partial(_cast, straight, plan, poses, elevation + height, grade, params),
            ranges,
            poses,
            judged=False,
        ),
    ]


def _simulated(plan: TunnelPlan, lining: str, poses: reference.Poses, params: lidar.LidarParams) -> np.ndarray:
    tunnel = Tunnel.from_plan(plan, lining)
    scan = jax.jit(jax.vmap(partial(lidar.scan, params=params), in_axes=(None, 0, 0, 0)))
    parts = np.array_split(np.arange(len(poses.station)), -(-len(poses.station) // _BATCH))
    ranges = [scan(tunnel, poses.position[i], poses.heading[i], poses.station[i]) for i in parts]
    return np.concatenate([np.asarray(part) for part in ranges]).astype(np.float64)


def _cast(
    caster: Caster,
    plan: TunnelPlan,
    poses: reference.Poses,
    height: np.ndarray,
    grade: np.ndarray,
    params: lidar.LidarParams,
    turn: float = 0.0,
) -> np.ndarray:
    """Ranges by embree, every beam turned further by `turn` rad."""
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
