"""Tasks on the rover: the Scout's motion by physics, in any tunnel."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar
from xml.etree import ElementTree

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from jaxtyping import Array

from subterra_jax.host import rover
from subterra_jax.host.errors import SubterraError
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.params import collect_entries
from subterra_jax.parts import Drive, Moved, Part, PlanarLidar, SpatialLidar
from subterra_jax.physics.engine import TIMESTEP, Body, Engine, Machine, MujocoEngine, set_options
from subterra_jax.physics.ground import RAIL_HALF, RAIL_OFFSET, Track, join_tracks, read_track
from subterra_jax.physics.riding import (
    Physical,
    Ride,
    SwayingLidar,
    SwayingSpatialLidar,
    advance_period,
    has_tipped,
    place_on,
)
from subterra_jax.physics.stage import scene_file, scene_world, tunnel_world
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import Source, list_sources, load_tunnel
from subterra_jax.tunnel_env import TunnelEnv

ENGINES = ("mjx", "mujoco")
_MARGIN = 0.1  # to either side of a robot's envelope, m
_ON_TRACK, _FROM_MOUTH = 0.3, 1.0  # of starts where none is given: largest lateral offset, least station, m


class RobotError(SubterraError):
    """A robot has no room, or cannot be built as asked."""


def rover_spec() -> mujoco.MjSpec:
    """Return the rover alone, with the options of the engine."""
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(rover.rover_mjcf(), encoding="unicode"))
    set_options(spec)
    for wheel in rover.WHEELS:
        # Its speed loop by the implicit Euler method: (M + h D) a = f. So contacts are solved for the wheel that the
        # motor holds, and one iteration does where three were needed.
        spec.joint(wheel).armature += TIMESTEP * rover.GAIN
    return spec


ROVER = Machine(rover_spec, rover.NAME, rover.WHEELS, rover.BUMPERS, rover.WHEEL_HALF)


@dataclasses.dataclass(frozen=True)
class Rover(Physical):
    """A Scout 2.0 by physics. Its wheels and its gyroscope tell the odometer how far it went.

    It takes the commands of the planar tasks, of up to 2 m/s, and drives at 1.5 m/s at most.

    Attributes:
        engine: MJX, or MuJoCo in C.
        periods: Control periods of the engine in one of the task.
    """

    engine: Engine = dataclasses.field(default_factory=lambda: Engine(ROVER))
    periods: int = 5
    lidar_place: tuple[float, float, float] = (0.0, 0.0, rover.LIDAR_HEIGHT - rover.HEIGHT)
    name: ClassVar[str] = "rover"

    def begin(self, draw: Any, state: State, params: EnvParams) -> Ride:
        pose, anchor = place_on(params.track, state, rover.HEIGHT)
        rest = jnp.zeros(6 + len(rover.WHEELS))
        body = Body(jnp.concatenate([pose, jnp.zeros(len(rover.WHEELS))]), rest, rest, jnp.zeros(2))
        return Ride(body, anchor)

    def move(self, state: State, drive: Drive, noise: Any, tunnel: Tunnel, params: EnvParams) -> Moved:
        """Drive for one control period of the task; see `Motion.move`. Slip is what the wheels do, not the task's."""

        def control(ride: Ride, nothing: None) -> tuple[Ride, tuple[Array, ...]]:
            ride, _, gap, wrong = advance_period(self.engine, ride, drive.wheels, None, params.track, tunnel)
            speeds = ride.body.qvel
            counted = jnp.stack([rover.ROLLED * jnp.mean(speeds[6:]), speeds[5]])
            return ride, (gap, wrong | has_tipped(ride.body), counted)

        ride, (gap, fallen, counted) = lax.scan(control, state.parts[self.name], None, length=self.periods)
        wheels, nearest = jnp.mean(counted, axis=0), jnp.min(gap)
        contact = nearest < self.engine.reach
        return self.moved(state, ride, wheels, nearest, contact, jnp.any(fallen), tunnel, params)

    def carried(self, part: Part) -> Part:
        """Return a LiDAR as this robot carries it; other parts as they are."""
        if isinstance(part, SpatialLidar):
            return SwayingSpatialLidar(motion=self)
        return SwayingLidar(motion=self) if isinstance(part, PlanarLidar) else part


def check_width(plan: TunnelPlan, width: float, robot: str) -> None:
    """Raise `RobotError` where a tunnel is narrower than a robot with 0.1 m to either side."""
    needed, narrowest = width + 2.0 * _MARGIN, int(np.argmin(plan.half_width))
    if (free := 2.0 * float(plan.half_width[narrowest])) < needed:
        raise RobotError(
            f"tunnel {plan.name!r} is {free:.2f} m wide at {plan.station[narrowest]:.1f} m; "
            f"the {robot} needs {needed:.2f} m"
        )


def on_rover(
    env: TunnelEnv,
    tunnel: Source | Sequence[Source],
    lining: str | None,
    piece: tuple[float, float] | None,
    overrides: Mapping[str, Any],
    hidden_start: bool = False,
) -> tuple[TunnelEnv, dict[str, Any]]:
    """Return a task on the rover, and its entries of `EnvParams`.

    Args:
        env: The task on wheels.
        tunnel: As for `subterra_jax.make`.
        lining: As for `subterra_jax.make`.
        piece: Start and length of the piece of tunnel, m; None for the whole.
        overrides: Entries in place of the defaults; and `engine`: `mjx`, for thousands on a GPU, or `mujoco`, in C on
            the host, for a few; and `scene`, the folder of a built scene, whose `scene.xml` that engine takes and whose
            triangles the LiDAR sees.
        hidden_start: The start among them is not the user's own.

    Raises:
        ValueError: There is no such engine or entry, the tunnel is a ready `Tunnel`, the engine in C gets many tunnels,
            or the start may be in a wall.
        RobotError: A tunnel is narrower than the robot.
        TrackError: A tunnel is too short, or a scene has no floor.
    """
    asked = dict(overrides)
    engine, scene = asked.pop("engine", ENGINES[0]), asked.pop("scene", None)
    if engine not in ENGINES:
        raise ValueError(f"no engine {engine!r}; there are {', '.join(ENGINES)}")
    plans = [_plan(source, piece) for source in ([tunnel] if isinstance(tunnel, Tunnel) else list_sources(tunnel))]
    for plan in plans:
        check_width(plan, 2.0 * rover.HALF_SIZE[1], "rover")
    tracks, motion = [read_track(plan) for plan in plans], Rover()
    if engine == "mujoco":
        if len(plans) > 1:
            raise ValueError(f"engine='mujoco' drives in one tunnel, got {len(plans)}")
        motion = Rover(engine=MujocoEngine(ROVER, world=world_of(plans[0], tracks[0], lining, scene)))
    env = dataclasses.replace(env, motion=motion, parts=tuple(motion.carried(part) for part in env.parts))
    relief = None if scene is None else Relief.from_plan(plans[0], lining)
    entries = collect_entries(env, {**asked, "track": join_tracks(tracks), "relief": relief})
    room = min(float(plan.half_width.min()) for plan in plans) - rover.HALF_SIZE[1]
    if any(float(track.rails[0]) > 0.0 for track in tracks):
        room = min(room, RAIL_OFFSET - RAIL_HALF[0] - rover.HALF_SIZE[1])
    return env, _with_start(entries, "start" in overrides and not hidden_start, room)


def world_of(plan: TunnelPlan, track: Track, lining: str | None, scene: str | Path | None) -> Any:
    """Return what makes the world of the engine in C: that of a scene, or that of a plan.

    Raises:
        TrackError: There is no such scene.
    """
    if scene is None:
        return lambda: tunnel_world(plan, track, lining)
    file = scene_file(scene, lining)
    return lambda: scene_world(file)


def _with_start(entries: Mapping[str, Any], given: bool, room: float) -> dict[str, Any]:
    """Entries whose start leaves room beside the robot; a start of the user's that does not is refused."""
    start = entries["start"]
    lateral = float(np.max(np.asarray(start.lateral)))
    if not given:
        near = {"station": max(start.station, _FROM_MOUTH), "lateral": min(lateral, room, _ON_TRACK)}
        return {**entries, "start": dataclasses.replace(start, **near)}
    if lateral > room + 1e-6:
        raise ValueError(
            f"start.lateral = {lateral:g} m may put the rover into a wall or onto a rail; {room:.2f} m are free"
        )
    return dict(entries)


def _plan(source: Source, piece: tuple[float, float] | None) -> TunnelPlan:
    if isinstance(source, Tunnel):
        raise ValueError("motion='rover' needs the tunnel's name, file or plan: a ready Tunnel holds no heights")
    plan = source if isinstance(source, TunnelPlan) else load_tunnel(source)
    if piece is None:
        return plan
    start, length = piece
    return plan.slice(start, min(length, plan.length - start))
