"""A robot's place: the ground of its tunnels, its engine, the room beside it; and a whole tunnel for MuJoCo in C.

That is a scene as it was built, or ground and walls of a plan.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import mujoco
import numpy as np

from subterra_jax.host.errors import SubterraError
from subterra_jax.host.rover import GROUND, LOW_WALL, RAIL, ROLL
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.params import collect_entries
from subterra_jax.physics.engine import Engine, Machine, MujocoEngine
from subterra_jax.physics.ground import RAIL_HALF, RAIL_OFFSET, SLEEPER_HALF, Track, TrackError, join_tracks, read_track
from subterra_jax.physics.riding import Physical
from subterra_jax.physics.warp import INSTALLED, WarpEngine
from subterra_jax.pictures.stage import add_box
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel_env import TunnelEnv

EngineName = Literal["mjx", "mjx-jax", "mjx-warp", "mujoco"]
ENGINES: tuple[EngineName, ...] = get_args(EngineName)
_MARGIN = 0.1  # to either side of a robot, m
_ON_TRACK, _FROM_MOUTH = 0.3, 1.0  # of starts where none is given: largest lateral offset, least station, m
_SCOUT = "scout"  # the robot that a scene comes with
_DEEP, _THICK = 0.05, 0.1  # half of a sleeper's or slab's box; of a wall, m
_WALL = (0.5, 2.0)  # walls reach from so far below the ground to so far above it, m
_OVERLAP, _PORCH = 0.01, 3.0  # of slabs, m: over the next one, and beyond the mouths
_BED, _RAIL, _SLEEPER, _GLASS = (0.35, 0.33, 0.31), (0.40, 0.33, 0.28), (0.62, 0.61, 0.58), (0.7, 0.7, 0.7, 0.3)


class RobotError(SubterraError):
    """A robot has no room."""


@dataclasses.dataclass(frozen=True)
class Stage:
    """A robot's place."""

    track: Track  # ground of its tunnels
    engine: Engine  # engine with the robot
    relief: Relief | None  # surface of a scene, which the LiDAR sees; None without a scene
    room: float  # distance to either side of the axis at which no side of the robot is at a wall or a rail, m

    def mount(
        self, env: TunnelEnv, motion: Physical, entries: Mapping[str, Any], given: bool
    ) -> tuple[TunnelEnv, dict[str, Any]]:
        """Return a task on a robot here, which carries its LiDAR, and its entries of `EnvParams`.

        Args:
            env: The task on wheels.
            motion: What moves the robot.
            entries: Entries in place of the defaults.
            given: The start among them is the user's own. Another is changed to leave room beside the robot.

        Raises:
            ValueError: There is no such entry, or the user's start leaves no room.
        """
        env = dataclasses.replace(env, motion=motion, parts=tuple(motion.carried(part) for part in env.parts))
        found = collect_entries(env, {"relief": self.relief, **entries, "track": self.track})
        start = found["start"]
        lateral = float(np.max(np.asarray(start.lateral)))
        if not given:
            near = {"station": max(start.station, _FROM_MOUTH), "lateral": min(lateral, self.room, _ON_TRACK)}
            return env, {**found, "start": dataclasses.replace(start, **near)}
        if lateral > self.room + 1e-6:
            raise ValueError(
                f"start.lateral = {lateral:g} m may put the {self.engine.machine.name} into a wall or onto a rail; "
                f"{self.room:.2f} m are free"
            )
        return env, found


def settle(
    machine: Machine, plans: Sequence[TunnelPlan], lining: str | None, scene: str | Path | None, engine: str
) -> Stage:
    """Put a robot into tunnels.

    Args:
        scene: Folder of the built scene that is the one tunnel, if it is.
        engine: `mjx`, for thousands on a GPU, by Warp where that is installed and else by JAX; `mjx-jax` or `mjx-warp`,
            one of these; or `mujoco`, in C on the host, for a few: in `scene.xml` where there is a scene.

    Raises:
        ValueError: There is no such engine, Warp is not installed, or that in C gets many tunnels.
        RobotError: A tunnel is narrower than the robot with 0.1 m to either side.
        TrackError: A tunnel is too short; or there is no such scene, or it has no floor.
    """
    if engine not in ENGINES:
        raise ValueError(f"no engine {engine!r}; there are {', '.join(ENGINES)}")
    needed = machine.width + 2.0 * _MARGIN
    for plan in plans:
        narrowest = int(np.argmin(plan.half_width))
        if (free := 2.0 * float(plan.half_width[narrowest])) < needed:
            raise RobotError(
                f"tunnel {plan.name!r} is {free:.2f} m wide at {plan.station[narrowest]:.1f} m; "
                f"the {machine.name} needs {needed:.2f} m"
            )
    tracks = [read_track(plan) for plan in plans]
    # A scene is read at once and by all engines, so that what is wrong with it is said before the first step.
    spec = None if scene is None else scene_world(scene_file(scene, lining))
    if engine == "mujoco":
        if len(plans) > 1:
            raise ValueError(f"engine='mujoco' drives in one tunnel, got {len(plans)}")
        made: Engine = MujocoEngine(
            machine, world=spec.copy if spec else lambda: tunnel_world(plans[0], tracks[0], lining)
        )
    else:
        if engine == "mjx-warp" and not INSTALLED:
            raise ValueError("engine='mjx-warp' needs Warp: pip install 'subterra-jax[warp]'")
        by_warp = INSTALLED and engine != "mjx-jax"
        made = WarpEngine(machine, on_cpu=engine == "mjx-warp") if by_warp else Engine(machine)
    room = min(float(plan.half_width.min()) for plan in plans)
    if any(float(track.rails[0]) > 0.0 for track in tracks):
        room = min(room, RAIL_OFFSET - RAIL_HALF[0])
    relief = None if scene is None else Relief.from_plan(plans[0], lining)
    return Stage(join_tracks(tracks), made, relief, room - 0.5 * machine.width)


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
    ends = segments.reshape(-1, 2, 2)
    chord = ends[:, 1] - ends[:, 0]
    size = np.linalg.norm(chord, axis=1)
    for k in np.flatnonzero(size > 1e-6):
        across = np.array([-chord[k, 1], chord[k, 0]]) / size[k]
        middle = ends[k].mean(axis=0)
        nearest = int(np.argmin(np.sum((plan.centre - middle) ** 2, axis=1)))
        outward = across if across @ (middle - plan.centre[nearest]) > 0.0 else -across
        centre = [*(middle + 0.5 * _THICK * outward), plan.elevation[nearest] + 0.5 * (_WALL[1] - _WALL[0])]
        half_turn = 0.5 * np.arctan2(chord[k, 1], chord[k, 0])
        half = (0.5 * size[k], 0.5 * _THICK, 0.5 * sum(_WALL))
        turn = np.array([np.cos(half_turn), 0.0, 0.0, np.sin(half_turn)])
        add_box(spec, half, centre, turn, _GLASS, LOW_WALL)
    return spec


def add_ground(spec: mujoco.MjSpec, track: Track, half_width: float, start: float = 0.0, end: float = np.inf) -> None:
    """Add ballast or floor, sleepers and rails between two stations, m, of one tunnel."""
    parts = (track.station, track.position, track.quaternion)
    station, position, turns = (np.asarray(part, np.float64) for part in parts)
    protrusion, rails = float(track.protrusion[0]), float(track.rails[0]) > 0.0
    chosen = np.flatnonzero((station >= start) & (station <= end))
    for k in chosen:
        if protrusion > 0.0:
            sunk = _beside(position[k], turns[k], 0.0, -_DEEP)
            add_box(spec, (*SLEEPER_HALF, _DEEP), sunk, turns[k], _SLEEPER, ROLL | GROUND)
        if k + 1 >= len(station):
            continue
        middle, turn = 0.5 * (position[k] + position[k + 1]), turns[k] + turns[k + 1] * np.sign(turns[k] @ turns[k + 1])
        turn /= np.linalg.norm(turn)
        beyond = _PORCH if k in (0, len(station) - 2) else _OVERLAP
        half = 0.5 * float(np.linalg.norm(position[k + 1] - position[k])) + beyond
        bed = _beside(middle, turn, 0.0, -protrusion - _DEEP)
        add_box(spec, (half, half_width, _DEEP), bed, turn, _BED, ROLL | GROUND)
        for side in (RAIL_OFFSET, -RAIL_OFFSET) if rails else ():
            add_box(spec, (half, *RAIL_HALF), _beside(middle, turn, side, RAIL_HALF[1]), turn, _RAIL, GROUND | RAIL)


def _beside(point: np.ndarray, turn: np.ndarray, left: float, up: float) -> np.ndarray:
    """Point so far to the left and above another, in turned axes, m."""
    turned = np.zeros(3)
    mujoco.mju_rotVecQuat(turned, np.array([0.0, left, up]), turn)
    return point + turned
