"""A whole tunnel for MuJoCo's own engine, and for pictures: a scene as it was built, or ground and walls of a plan."""

from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from subterra_jax.host.rover import GROUND, LOW_WALL, RAIL, ROLL
from subterra_jax.physics.ground import RAIL_HALF, RAIL_OFFSET, SLEEPER_HALF, Track, TrackError
from subterra_jax.tunnel.plan import TunnelPlan

_SCOUT = "scout"  # the robot that a scene comes with
_DEEP, _THICK = 0.05, 0.1  # half of a sleeper's or slab's box; of a wall, m
_WALL = (0.5, 2.0)  # walls reach from so far below the ground to so far above it, m
_OVERLAP, _PORCH = 0.01, 3.0  # of slabs, m: over the next one, and beyond the mouths
_BED, _RAIL, _SLEEPER = (0.35, 0.33, 0.31, 1.0), (0.40, 0.33, 0.28, 1.0), (0.62, 0.61, 0.58, 1.0)


def scene_file(scene: str | Path, lining: str | None) -> Path:
    """Return the MJCF file of a scene folder: the one with furniture where the lining is `furnished`.

    Raises:
        TrackError: It is missing.
    """
    file = Path(scene) / ("scene_furnished.xml" if lining == "furnished" else "scene.xml")
    if not file.is_file():
        raise TrackError(f"{file} is missing")
    return file


def scene_world(file: Path) -> mujoco.MjSpec:
    """Return a scene without the robot that it comes with.

    Raises:
        TrackError: The scene cannot be read, or has no floor.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(file))
    except ValueError as cause:
        raise TrackError(f"{file}: not a readable scene ({cause})") from cause
    if not any(geom.contype & GROUND for geom in spec.geoms):
        raise TrackError(f"{file}: no geom has the contype {GROUND} of the ground: the scene has no floor")
    for owned in (*spec.actuators, *spec.tendons, *spec.sensors):
        spec.delete(owned)
    if scout := spec.body(_SCOUT):
        spec.delete(scout)
    return spec


def tunnel_world(plan: TunnelPlan, track: Track, lining: str | None = None) -> mujoco.MjSpec:
    """Return ground and walls of a plan as boxes, upright walls as the planar tunnel has them."""
    spec = mujoco.MjSpec()
    add_ground(spec, track, 1.0 + float(plan.half_width.max()))
    segments = plan.lining(lining or plan.default_lining).segments
    floor = np.interp(_stations(plan, segments), plan.station, plan.elevation)
    ends = segments.reshape(-1, 2, 2)
    chord = ends[:, 1] - ends[:, 0]
    size = np.linalg.norm(chord, axis=1)
    for k in np.flatnonzero(size > 1e-6):
        across = np.array([-chord[k, 1], chord[k, 0]]) / size[k]
        middle = ends[k].mean(axis=0)
        nearest = plan.centre[np.argmin(np.sum((plan.centre - middle) ** 2, axis=1))]
        outward = across if across @ (middle - nearest) > 0.0 else -across
        centre = [*(middle + 0.5 * _THICK * outward), floor[k] + 0.5 * (_WALL[1] - _WALL[0])]
        half_turn = 0.5 * np.arctan2(chord[k, 1], chord[k, 0])
        half = (0.5 * size[k], 0.5 * _THICK, 0.5 * sum(_WALL))
        turn = np.array([np.cos(half_turn), 0.0, 0.0, np.sin(half_turn)])
        _add_box(spec, half, np.array(centre), turn, LOW_WALL, (0.7, 0.7, 0.7, 0.3))
    return spec


def _stations(plan: TunnelPlan, segments: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n"]:
    middle = 0.5 * (segments[:, :2] + segments[:, 2:])
    return plan.station[[int(np.argmin(np.sum((plan.centre - point) ** 2, axis=1))) for point in middle]]


def add_ground(spec: mujoco.MjSpec, track: Track, half_width: float, start: float = 0.0, end: float = np.inf) -> None:
    """Add ballast or floor, sleepers and rails between two stations, m, of one tunnel."""
    parts = (track.station, track.position, track.quaternion)
    station, position, turns = (np.asarray(part, np.float64) for part in parts)
    protrusion, rails = float(track.protrusion[0]), float(track.rails[0]) > 0.0
    chosen = np.flatnonzero((station >= start) & (station <= end))
    for k in chosen:
        if protrusion > 0.0:
            sunk = _beside(position[k], turns[k], 0.0, -_DEEP)
            _add_box(spec, (*SLEEPER_HALF, _DEEP), sunk, turns[k], ROLL | GROUND, _SLEEPER)
        if k + 1 >= len(station):
            continue
        middle, turn = 0.5 * (position[k] + position[k + 1]), _mean(turns[k], turns[k + 1])
        beyond = _PORCH if k in (0, len(station) - 2) else _OVERLAP
        half = 0.5 * float(np.linalg.norm(position[k + 1] - position[k])) + beyond
        bed = _beside(middle, turn, 0.0, -protrusion - _DEEP)
        _add_box(spec, (half, half_width, _DEEP), bed, turn, ROLL | GROUND, _BED)
        for side in (RAIL_OFFSET, -RAIL_OFFSET) if rails else ():
            _add_box(spec, (half, *RAIL_HALF), _beside(middle, turn, side, RAIL_HALF[1]), turn, GROUND | RAIL, _RAIL)


def _mean(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    total = first + second * np.sign(first @ second)
    return total / np.linalg.norm(total)


def _beside(point: np.ndarray, turn: np.ndarray, left: float, up: float) -> np.ndarray:
    """Point so far to the left and above another, in turned axes, m."""
    turned = np.zeros(3)
    mujoco.mju_rotVecQuat(turned, np.array([0.0, left, up]), turn)
    return point + turned


def _add_box(
    spec: mujoco.MjSpec,
    half: tuple[float, ...],
    middle: np.ndarray,
    turn: np.ndarray,
    bits: int,
    colour: tuple[float, ...],
) -> None:
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=middle, quat=turn, contype=bits, conaffinity=0, group=1,
        rgba=colour,
    )  # fmt: skip
