"""A planar task done on four legs: the B2's gait as a motion.

Five times a second a driver commands `[v, ω]`; fifty times a second the gait obeys.
"""

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, PRNGKeyArray

from subterra_jax.b2 import constants as b2
from subterra_jax.b2 import draws
from subterra_jax.b2.params import WalkResetNoise, WalkState, WalkStepNoise
from subterra_jax.b2.walk import WalkEnv
from subterra_jax.parts import Drive, Moved
from subterra_jax.parts.part import Batch, Keys
from subterra_jax.physics.riding import Physical
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel

PERIODS = 10  # control periods of the gait in one of the task


@dataclasses.dataclass(frozen=True)
class Legs(Physical):
    """A Unitree B2 on a frozen gait; its standing legs and its gyroscope tell the odometer how far it went.

    Attributes:
        walk: The walking robot, driven from outside.
    """

    walk: WalkEnv = dataclasses.field(default_factory=lambda: WalkEnv(driven=True))
    lidar_place: tuple[float, float, float] = b2.LIDAR
    name: ClassVar[str] = "legs"
    streams: ClassVar[tuple[int, ...]] = (2,)

    def defaults(self) -> dict[str, Any]:
        """Return `vehicle`, limits of a command; `track`; `walk`, the robot; and `policy`, its gait (None: trot)."""
        return {**super().defaults(), "walk": None, "policy": None}

    def draw_reset(self, key: Keys, batch: Batch, params: EnvParams) -> WalkResetNoise:
        """Draw how the robot is built, and its first readings."""
        return self.walk.draw_reset(key, batch, params.walk)

    def draw_step(self, key: PRNGKeyArray, batch: Batch, params: EnvParams) -> WalkStepNoise:
        return self.walk.draw_step(key, (*batch, PERIODS), params.walk)

    def begin(self, draw: WalkResetNoise, state: State, params: EnvParams) -> WalkState:
        return draws.begin(draw, params.walk, state)

    def move(self, state: State, drive: Drive, noise: WalkStepNoise, tunnel: Tunnel, params: EnvParams) -> Moved:
        """Walk for one control period of the task; see `Motion.move`."""
        command = jnp.stack([drive.wheels[0], jnp.zeros(()), drive.wheels[1]])
        walk = dataclasses.replace(state.legs, command=command)

        def control(walk: WalkState, drawn: WalkStepNoise) -> tuple[WalkState, tuple[Array, ...]]:
            action = jnp.zeros(12)
            if params.policy is not None:
                action = params.policy.act(self.walk.observe(walk, drawn, params.walk))
            walk, _, fall, _, info = self.walk.advance(walk, action, drawn, params.walk)
            sensors = walk.proprioception
            # About the vertical, whichever way the trunk leans.
            turning = -jnp.sum(sensors.rates * sensors.gravity)
            return walk, (jnp.stack([sensors.velocity[0], turning]), info["clearance"], info["contact"], fall)

        walk, (counted, gap, contact, fall) = lax.scan(control, walk, noise)
        wheels, clear = jnp.mean(counted, axis=0), jnp.min(gap)
        return self.moved(state, walk, wheels, clear, jnp.any(contact), jnp.any(fall), tunnel, params)
