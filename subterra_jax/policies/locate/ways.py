"""A learnt localiser on a way out and a way back: at the flag it knows where it is, and it begins anew once turned."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.agent import Known, Observed
from subterra_jax.baselines.stations import Driven, Localiser, Station
from subterra_jax.policies.locate.locator import Locator, LocatorMemory

_LATE = 0.1  # m driven, in the mean, before the step at which the flag is seen
_FLAG_SIGMA = 0.1  # m


@struct.dataclass
class WayMemory:
    """Memory of both ways."""

    origin: Float[Array, ""]  # station at which this way began, m; while turning, the station
    direction: Float[Array, ""]  # 1 on the way out, -1 on the way back
    turning: Bool[Array, ""]  # true from the flag until the robot has turned
    locator: LocatorMemory  # memory of this way


@struct.dataclass
class TwoWays(Localiser):
    """Counts each way by a learnt localiser, which only knows driving forward."""

    locator: Locator  # the localiser

    def begin(self, obs: Observed, params: Any) -> WayMemory:
        locator = self.locator.begin(obs, params)
        return WayMemory(locator.begin, jnp.ones(()), jnp.zeros((), bool), locator)

    def update(
        self, before: WayMemory, obs: Observed, driven: Driven, params: Any, known: Known
    ) -> tuple[Station, WayMemory]:
        """Takes in a step; while turning it counts commands."""
        turned = driven.direction != before.direction
        turning = (before.turning | driven.flagged) & ~turned
        step = before.direction * driven.cosine * driven.speed * params.vehicle.period
        at_flag = obs.goal - before.direction * (params.goal.flag_reach - _LATE)
        origin = jnp.where(driven.flagged, at_flag, before.origin + jnp.where(before.turning, step, 0.0))
        count, after = self.locator.update(before.locator, obs, driven, params, known)
        fresh = self.locator.begin(obs, params)
        locator = jax.tree.map(
            lambda new, same, anew: jnp.where(turned, anew, jnp.where(turning, same, new)), after, before.locator, fresh
        )
        moved = jnp.where(turning | turned, 0.0, count.station - before.locator.begin)
        log_sigma = jnp.where(turning | turned, jnp.log(_FLAG_SIGMA), count.log_sigma)
        memory = WayMemory(origin, driven.direction, turning, locator)
        return Station(origin + driven.direction * moved, log_sigma, driven.direction), memory
