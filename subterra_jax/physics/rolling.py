"""Tasks on the rover: the Scout's motion by physics, in any tunnel."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar
from xml.etree import ElementTree

import jax.numpy as jnp
import mujoco
from jax import lax
from jaxtyping import Array

from subterra_jax.host import rover
from subterra_jax.parts import Drive, Moved
from subterra_jax.physics.engine import TIMESTEP, Body, Engine, Machine, set_options
from subterra_jax.physics.riding import Physical, Ride, advance_period, has_tipped, place_on
from subterra_jax.physics.stage import ENGINES, settle
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import Source, list_sources, load_tunnel
from subterra_jax.tunnel_env import TunnelEnv


def rover_spec() -> mujoco.MjSpec:
    """Return the rover alone, with the options of the engine."""
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(rover.rover_mjcf(), encoding="unicode"))
    set_options(spec)
    spec.option.iterations = 2  # with one, wheels slip on sleepers by 8 % more than with ten
    for wheel in rover.WHEELS:
        # Its speed loop by the implicit Euler method: (M + h D) a = f. So contacts are solved for the wheel that the
        # motor holds, and two iterations do.
        spec.joint(wheel).armature += TIMESTEP * rover.GAIN
    return spec


ROVER = Machine(
    "rover", 2.0 * rover.HALF_SIZE[1], rover_spec, rover.NAME, rover.WHEELS, rover.BUMPERS, rover.WHEEL_HALF
)


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
            sleepers = params.track.protrusion[ride.anchor] > 0.0
            rolled = jnp.where(sleepers, rover.ROLLED_ON_SLEEPERS, rover.ROLLED)
            counted = jnp.stack([rolled * jnp.mean(speeds[6:]), speeds[5]])
            return ride, (gap, wrong | has_tipped(ride.body), counted)

        ride, (gap, fallen, counted) = lax.scan(control, state.parts[self.name], None, length=self.periods)
        wheels, nearest = jnp.mean(counted, axis=0), jnp.min(gap)
        contact = nearest < self.engine.reach
        return self.moved(state, ride, wheels, nearest, contact, jnp.any(fallen), tunnel, params)


def on_rover(
    env: TunnelEnv,
    tunnel: Source | Sequence[Source],
    lining: str | None,
    stretch: tuple[float, float] | None,
    overrides: Mapping[str, Any],
    hidden_start: bool = False,
) -> tuple[TunnelEnv, dict[str, Any]]:
    """Return a task on the rover, and its entries of `EnvParams`.

    Args:
        env: The task on wheels.
        tunnel: As for `subterra_jax.make`.
        lining: As for `subterra_jax.make`.
        stretch: Start and length of the stretch of tunnel, m; None for the whole.
        overrides: Entries in place of the defaults; and `engine`, as for `settle`; and `scene`, the folder of a built
            scene, whose `scene.xml` MuJoCo's engine takes and whose triangles the LiDAR sees.
        hidden_start: The start among them is not the user's own.

    Raises:
        ValueError: There is no such entry, the tunnel is a ready `Tunnel`, the start may be in a wall; or as `settle`.
        SubterraError: As `settle`.
    """
    asked = dict(overrides)
    engine, scene = asked.pop("engine", ENGINES[0]), asked.pop("scene", None)
    plans = [_plan(source, stretch) for source in ([tunnel] if isinstance(tunnel, Tunnel) else list_sources(tunnel))]
    stage = settle(ROVER, plans, lining, scene, engine)
    return stage.mount(env, Rover(engine=stage.engine), asked, "start" in overrides and not hidden_start)


def _plan(source: Source, stretch: tuple[float, float] | None) -> TunnelPlan:
    if isinstance(source, Tunnel):
        raise ValueError("motion='rover' needs the tunnel's name, file or plan: a ready Tunnel holds no heights")
    return (source if isinstance(source, TunnelPlan) else load_tunnel(source)).stretch(stretch)
