"""A trained multilayer perceptron over stacked observations, as an agent."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Known, Observed
from subterra_jax.policies.layers import Tensors, perceptron, squash
from subterra_jax.state import EnvParams

_CLIP = 10.0  # standard deviations


@struct.dataclass
class FeedForward:
    """Drives by the mean of its distribution; says where it is only where the task has it report.

    Attributes:
        tensors: `statistics.mean` and `statistics.std` of one observation, and the layers `policy.hidden_<i>`.
        low: Smallest action.
        high: Largest action.
        frames: Observations it sees at once.
        name: Name on the leaderboard.
    """

    tensors: Tensors
    low: Float[Array, "n_action"]
    high: Float[Array, "n_action"]
    frames: int = struct.field(pytree_node=False)
    name: str = struct.field(pytree_node=False, default="ppo-mlp")
    uses_lidar: bool = struct.field(pytree_node=False, default=True)
    uses_map: bool = struct.field(pytree_node=False, default=False)
    privileged: bool = struct.field(pytree_node=False, default=False)

    @property
    def n_observation(self) -> int:
        """Numbers in one observation."""
        return self.tensors["statistics.mean"].shape[0]

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> Float[Array, "frames n_obs"]:
        """The first observation, repeated."""
        del key, params
        return jnp.repeat(obs.flat[None], self.frames, axis=0)

    def act(
        self, key: PRNGKeyArray, memory: Float[Array, "frames n_obs"], obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, Float[Array, "frames n_obs"]]:
        """One control period."""
        del key, params, known
        stack = jnp.concatenate([memory[1:], obs.flat[None]])
        return self.answer(stack), stack

    def answer(self, stack: Float[Array, "frames n_obs"]) -> Action:
        """The action for a stack of observations, oldest first."""
        seen = (stack - self.tensors["statistics.mean"]) / self.tensors["statistics.std"]
        parameters = perceptron(self.tensors, "policy", jnp.clip(seen, -_CLIP, _CLIP).reshape(-1), jax.nn.swish)
        n_action = len(self.low)
        nothing = jnp.array([0.0, 0.0, jnp.nan, 0.0, 0.0])
        return nothing.at[:n_action].set(squash(parameters[:n_action], self.low, self.high))
