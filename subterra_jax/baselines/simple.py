"""Agents that know nothing: random actions, and blind driving straight on."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Known, Observed
from subterra_jax.state import EnvParams


@struct.dataclass
class Random:
    """Uniform commands, and no estimate."""

    name: str = struct.field(pytree_node=False, default="random")
    uses_lidar: bool = struct.field(pytree_node=False, default=False)
    uses_map: bool = struct.field(pytree_node=False, default=False)
    privileged: bool = struct.field(pytree_node=False, default=False)

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> Float[Array, ""]:
        """Nothing to remember."""
        del key, obs, params
        return jnp.zeros(())

    def act(
        self, key: PRNGKeyArray, memory: Float[Array, ""], obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, Float[Array, ""]]:
        """Anything within the limits."""
        del obs, known
        share = jax.random.uniform(key, (3,))
        speed = params.vehicle.speed_max * share[0]
        yaw_rate = params.vehicle.yaw_rate_max * (2.0 * share[1] - 1.0)
        nothing = jnp.full((), jnp.nan)
        return jnp.stack([speed, yaw_rate, nothing, jnp.zeros(()), 2.0 * share[2] - 1.0]), memory
