"""Policy and value networks over stacked, normalised observations."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from train import learning
from train.learning import MLP, NormalTanhDistribution

Weights = Any  # nested dict of arrays, as flax makes it


@dataclasses.dataclass(frozen=True)
class Layout:
    """Shapes of all arrays and meaning of the outputs; a checkpoint carries it.

    Attributes:
        n_observation: Floats in one observation.
        action_low: Smallest action, m/s and rad/s.
        action_high: Largest action, m/s and rad/s.
        frames: Observations in the stack.
        hidden: Widths of the hidden layers.
        init_std: Standard deviation of the untrained policy before the tanh.
        min_std: Its floor.
    """

    n_observation: int
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    frames: int
    hidden: tuple[int, ...]
    init_std: float
    min_std: float


@struct.dataclass
class Policy:
    """Weights and statistics that acting needs.

    Attributes:
        weights: Of the policy network.
        statistics: Normalisation of one observation.
    """

    weights: Weights
    statistics: learning.Statistics


class Networks:
    """A Gaussian squashed by tanh onto the action range, and a value; both read the same stack."""

    kind = "mlp"

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.n_action = len(layout.action_low)
        self.distribution = NormalTanhDistribution(self.n_action, min_std=layout.min_std)
        self._policy = MLP(
            layer_sizes=(*layout.hidden, self.distribution.param_size),
            activation=jax.nn.swish,
            # A nearly constant first policy: the centre of the action range, with the spread asked for everywhere.
            output_kernel_init=jax.nn.initializers.variance_scaling(1e-4, "fan_in", "uniform"),
        )
        self._value = MLP(layer_sizes=(*layout.hidden, 1), activation=jax.nn.swish)
        self._low, self._high = jnp.asarray(layout.action_low), jnp.asarray(layout.action_high)
        spread = math.log(
            math.expm1(layout.init_std - layout.min_std)
        )  # inverse of the softplus inside the distribution
        self._offset = jnp.concatenate([jnp.zeros(self.n_action), jnp.full(self.n_action, spread)])

    def init(self, key: PRNGKeyArray) -> dict[str, Weights]:
        """Returns untrained weights, under `policy` and `value`."""
        key_policy, key_value = jax.random.split(key)
        flat = jnp.zeros((1, self.layout.frames * self.layout.n_observation))
        return {"policy": self._policy.init(key_policy, flat), "value": self._value.init(key_value, flat)}

    def policy_shapes(self) -> Policy:
        """Returns a policy with shapes in place of arrays."""
        return jax.eval_shape(
            lambda key: Policy(self.init(key)["policy"], learning.start_statistics((self.layout.n_observation,))),
            jax.random.key(0),
        )

    def parameters(
        self, weights: Weights, statistics: learning.Statistics, stack: Float[Array, "*batch frames obs"]
    ) -> Float[Array, "*batch parameters"]:
        """Returns parameters of the action distribution before the tanh: means, then spreads."""
        return self._policy.apply(weights, self._flatten(stack, statistics)) + self._offset

    def value(
        self, weights: Weights, statistics: learning.Statistics, stack: Float[Array, "*batch frames obs"]
    ) -> Float[Array, "*batch"]:
        """Estimates the return, in units of the reward scale."""
        return self._value.apply(weights, self._flatten(stack, statistics))[..., 0]

    def action(self, raw: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """Returns the action in m/s and rad/s for a draw of the Gaussian."""
        return self._low + 0.5 * (jnp.tanh(raw) + 1.0) * (self._high - self._low)

    def act(self, policy: Policy, stack: Float[Array, "*batch frames obs"]) -> Float[Array, "*batch action"]:
        """Returns the deterministic action, the centre of the distribution."""
        parameters = self.parameters(policy.weights, policy.statistics, stack)
        return self.action(parameters[..., : self.n_action])

    def _flatten(self, stack: Array, statistics: learning.Statistics) -> Array:
        normalized = learning.normalize(stack, statistics)
        return normalized.reshape(*stack.shape[:-2], -1)
