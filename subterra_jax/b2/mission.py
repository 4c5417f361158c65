"""A planar task done on four legs: the B2's gait as a motion, its LiDAR and its odometer as parts.

Five times a second a driver commands `[v, ω]`; fifty times a second the gait obeys.
"""

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.b2 import draws, posing
from subterra_jax.b2.params import WalkResetNoise, WalkState, WalkStepNoise
from subterra_jax.b2.sight import scan as trunk_scan
from subterra_jax.b2.walk import WalkEnv
from subterra_jax.parts import Drive, Moved, Noise, Odometer, PlanarLidar, Sight, Step, Unicycle
from subterra_jax.parts.odometer import OdometryState
from subterra_jax.parts.part import Batch, Keys
from subterra_jax.parts.unicycle import wrap
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel, foot

PERIODS = 10  # control periods of the gait in one of the task
_BEYOND = 0.5  # m outside a mouth at which the trunk's middle has left the tunnel


@struct.dataclass
class Tread:
    """Sums over the control periods of one step.

    Attributes:
        distance: Distance by leg odometry, m.
        turn: Turn by the gyroscope, rad.
        clearance: Least distance to a wall, m.
        contact: 1 where a wall was touched, else 0.
        fall: 1 where the robot fell, else 0.
    """

    distance: Float[Array, ""]
    turn: Float[Array, ""]
    clearance: Float[Array, ""]
    contact: Float[Array, ""]
    fall: Float[Array, ""]


@struct.dataclass
class LegsState:
    """A robot on its legs.

    Attributes:
        walk: State of the walking robot.
        tread: Sums over the last step.
    """

    walk: WalkState
    tread: Tread


@dataclasses.dataclass(frozen=True)
class Legs(Unicycle):
    """A Unitree B2 on a frozen gait.

    `info` also has `fall`, and the `height` of the trunk over the sleepers (m). `clearance` is the least of the step,
    from the nearer of the two discs that make up the robot's envelope.

    Attributes:
        walk: The walking robot, driven from outside.
    """

    walk: WalkEnv = dataclasses.field(default_factory=lambda: WalkEnv(driven=True))
    name: ClassVar[str] = "legs"
    on_the_plan: ClassVar[bool] = False
    streams: ClassVar[tuple[int, ...]] = (2,)

    def defaults(self) -> dict[str, Any]:
        """Return `vehicle`, the limits of a command; `walk`, the robot; and `policy`, its gait (None: the trot)."""
        return {**super().defaults(), "walk": None, "policy": None}

    def draw_reset(self, key: Keys, batch: Batch, params: EnvParams) -> WalkResetNoise:
        """Draw how the robot is built, and its first readings."""
        del params
        return draws.draw_reset(key, batch)

    def draw_step(self, key: PRNGKeyArray, batch: Batch, params: EnvParams) -> WalkStepNoise:
        """Draw the noise of each control period."""
        del params
        return draws.draw_step(key, (*batch, PERIODS))

    def begin(self, draw: WalkResetNoise, state: State, params: EnvParams) -> LegsState:
        """Stand where the task has its start."""
        zero = jnp.zeros(())
        return LegsState(posing.stand(state, draw, params.walk), Tread(zero, zero, zero, zero, zero))

    def move(self, state: State, drive: Drive, noise: WalkStepNoise, tunnel: Tunnel, params: EnvParams) -> Moved:
        """Walk for one control period of the task; see `Motion.move`."""
        walk, tread, height = self._walk(state.legs.walk, drive.wheels, noise, params)
        position, heading = posing.seen_from_above(walk, params.walk)
        motion = _mean_motion(state, position, heading, params)
        fall = tread.fall > 0.0
        outside = _outside(foot(tunnel, position, state.station).station, tunnel)
        return Moved(
            position=position,
            heading=heading,
            drive=Drive(motion, motion),
            own=LegsState(walk, tread),
            clearance=tread.clearance,
            contact=(tread.contact > 0.0) | outside,
            fallen=fall,
            info={"height": height, "fall": fall},
        )

    def height(self, state: State, params: EnvParams) -> Float[Array, ""]:
        """Return the height of the trunk, tunnel frame, m."""
        walk = state.legs.walk
        return params.walk.track.position[walk.anchor, 2] + walk.body.qpos[2]

    def _walk(
        self, walk: WalkState, command: Float[Array, "2"], noise: WalkStepNoise, params: EnvParams
    ) -> tuple[WalkState, Tread, Float[Array, ""]]:
        """The robot at the end of a step, the sums over it, and the height of its trunk, m."""
        walk = dataclasses.replace(walk, command=jnp.stack([command[0], jnp.zeros(()), command[1]]))
        period = self.walk.physics.period

        def control(walk: WalkState, drawn: WalkStepNoise) -> tuple[WalkState, tuple[Tread, Array]]:
            action = jnp.zeros(12)
            if params.policy is not None:
                action = params.policy.act(self.walk.observe(walk, drawn, params.walk))
            walk, _, fall, _, info = self.walk.advance(walk, action, drawn, params.walk)
            felt = walk.proprioception
            # About the vertical, whichever way the trunk leans.
            turning = -jnp.sum(felt.rates * felt.gravity)
            contact, fell = (flag.astype(jnp.float32) for flag in (info["contact"], fall))
            tread = Tread(felt.velocity[0] * period, turning * period, info["clearance"], contact, fell)
            return walk, (tread, info["height"])

        walk, (treads, height) = lax.scan(control, walk, noise)
        tread = Tread(
            distance=jnp.sum(treads.distance),
            turn=jnp.sum(treads.turn),
            clearance=jnp.min(treads.clearance),
            contact=jnp.max(treads.contact),
            fall=jnp.max(treads.fall),
        )
        return walk, tread, height[-1]


@dataclasses.dataclass(frozen=True)
class LegOdometer(Odometer):
    """Distance by the standing legs and heading by the gyroscope, with the bias of the heading that the task states."""

    def advance(self, own: OdometryState, step: Step, noise: Noise, params: EnvParams) -> OdometryState:
        """Add what legs and gyroscope measured."""
        del noise
        tread = step.after[Legs.name].tread
        turned = tread.turn + own.heading_bias * jnp.asarray(params.vehicle.period)
        return dataclasses.replace(own, distance=own.distance + tread.distance, heading=wrap(own.heading + turned))


@dataclasses.dataclass(frozen=True)
class TrunkLidar(PlanarLidar):
    """The planar LiDAR where the trunk has it, tilted as the trunk is."""

    def defaults(self) -> dict[str, Any]:
        """Return `lidar`, and `relief`: the surface that it sees; None for the planar tunnel with upright walls."""
        return {**super().defaults(), "relief": None}

    def true_ranges(self, own: Any, sight: Sight, params: EnvParams) -> Array:
        """Cast the beams from the trunk, m."""
        del own
        walk = sight.parts[Legs.name].walk
        return trunk_scan(walk, sight.station, params.walk, params.lidar, params.relief)

    def skips_unwanted(self, params: EnvParams) -> bool:
        """Tell that every scan is cast."""
        del params
        return False


def _mean_motion(
    state: State, position: Float[Array, "2"], heading: Float[Array, ""], params: EnvParams
) -> Float[Array, "2"]:
    """Mean speed of the trunk along its mean heading (m/s) and its yaw rate (rad/s) in a step."""
    turned = wrap(heading - state.heading)
    middle = state.heading + 0.5 * turned
    x, y = position - state.position
    ahead = x * jnp.cos(middle) + y * jnp.sin(middle)
    return jnp.stack([ahead, turned]) / params.vehicle.period


def _outside(station: Float[Array, ""], tunnel: Tunnel) -> Bool[Array, ""]:
    """Tell whether the trunk's middle has left the tunnel."""
    return (station < -_BEYOND) | (station > tunnel.length + _BEYOND)
