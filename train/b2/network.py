"""Networks of the walking robot: the policy sees what the robot feels, the critic what is true as well."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.policies.files import GAIT
from train.b2.config import WalkConfig
from train.feedforward import normalize
from train.feedforward.learner import Learner, make_layout
from train.feedforward.networks import Layout, Networks, Policy, Weights


@dataclasses.dataclass(frozen=True)
class WalkLayout(Layout):
    """As `Layout`.

    Attributes:
        n_seen: Numbers at the head of the observation that the policy sees.
    """

    n_seen: int = 0


class WalkNetworks(Networks):
    """A policy of the first numbers of the observation, and a value of all of them."""

    kind = GAIT
    layout: WalkLayout

    def init(self, key: PRNGKeyArray) -> dict[str, Weights]:
        """Untrained weights, under `policy` and `value`."""
        key_policy, key_value = jax.random.split(key)
        frames, whole, seen = self.layout.frames, self.layout.n_observation, self.layout.n_seen
        return {
            "policy": self._policy.init(key_policy, jnp.zeros((1, frames * seen))),
            "value": self._value.init(key_value, jnp.zeros((1, frames * whole))),
        }

    def parameters(
        self, weights: Weights, statistics: normalize.Statistics, stack: Float[Array, "*batch frames obs"]
    ) -> Float[Array, "*batch parameters"]:
        """Parameters of the action distribution before the tanh: means, then spreads."""
        seen = normalize.normalize(stack, statistics)[..., : self.layout.n_seen]
        return self._policy.apply(weights, seen.reshape(*stack.shape[:-2], -1)) + self._offset

    def tensors(self, policy: Policy) -> dict[str, Any]:
        """What walking needs of a policy, as a tree whose names `subterra_jax.b2.gait` knows."""
        seen = slice(0, self.layout.n_seen)
        statistics = {"mean": policy.statistics.mean[seen], "std": policy.statistics.std[seen]}
        return {"policy": policy.weights, "statistics": statistics}


class WalkLearner(Learner):
    """PPO whose critic sees the truth.

    Args:
        env: A walking environment whose observation ends with the truth.
        params: Its parameters.
        config: Settings.
        n_seen: Numbers of the observation that the policy sees.

    Raises:
        ConfigError: A setting makes no sense.
    """

    def __init__(self, env: Any, params: Any, config: WalkConfig, n_seen: int) -> None:
        super().__init__(env, params, config)
        layout = make_layout(env, params, config)
        self.networks = WalkNetworks(WalkLayout(**dataclasses.asdict(layout), n_seen=n_seen))
