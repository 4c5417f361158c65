"""Policy and value networks over stacked, normalised observations."""

import dataclasses
import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.policies import senses
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
        image: Rows and columns of the image in an observation, which is seen patch by patch; None without one.
        image_at: Place of its first pixel in an observation.
    """

    n_observation: int
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    frames: int
    hidden: tuple[int, ...]
    init_std: float
    min_std: float
    image: tuple[int, int] | None = dataclasses.field(default=None, kw_only=True)
    image_at: int = dataclasses.field(default=0, kw_only=True)


class Seeing(nn.Module):
    """A perceptron that sees the image of each frame at a glance, and all else as it is.

    Attributes:
        image: Rows and columns of the image.
        body: The perceptron.
    """

    image: tuple[int, int]
    body: nn.Module

    @nn.compact
    def __call__(
        self, plain: Float[Array, "*batch frames n"], image: Float[Array, "*batch frames pixels"]
    ) -> Float[Array, "*batch out"]:
        """Returns the perceptron's answer to a stack."""
        seen = jnp.concatenate([plain, learning.glance(image, self.image)], axis=-1)
        return self.body(seen.reshape(*seen.shape[:-2], -1))


@struct.dataclass
class Policy:
    """Weights and statistics that acting needs.

    Attributes:
        weights: Weights of the policy network.
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
        self._policy = self._with_sight(
            MLP(
                layer_sizes=(*layout.hidden, self.distribution.param_size),
                activation=jax.nn.swish,
                # A nearly constant first policy: the centre of the action range, with the spread asked for everywhere.
                output_kernel_init=jax.nn.initializers.variance_scaling(1e-4, "fan_in", "uniform"),
            )
        )
        self._value = self._with_sight(MLP(layer_sizes=(*layout.hidden, 1), activation=jax.nn.swish))
        self._low, self._high = jnp.asarray(layout.action_low), jnp.asarray(layout.action_high)
        spread = math.log(
            math.expm1(layout.init_std - layout.min_std)
        )  # inverse of the softplus inside the distribution
        self._offset = jnp.concatenate([jnp.zeros(self.n_action), jnp.full(self.n_action, spread)])

    def init(self, key: PRNGKeyArray) -> dict[str, Weights]:
        """Returns untrained weights, under `policy` and `value`."""
        key_policy, key_value = jax.random.split(key)
        shape = (self.layout.n_observation,)
        seen = self._see(jnp.zeros((1, self.layout.frames, *shape)), learning.start_statistics(shape))
        return {"policy": self._policy.init(key_policy, *seen), "value": self._value.init(key_value, *seen)}

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
        return self._policy.apply(weights, *self._see(stack, statistics)) + self._offset

    def value(
        self, weights: Weights, statistics: learning.Statistics, stack: Float[Array, "*batch frames obs"]
    ) -> Float[Array, "*batch"]:
        """Estimates the return, in units of the reward scale."""
        return self._value.apply(weights, *self._see(stack, statistics))[..., 0]

    def action(self, raw: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """Returns the action in m/s and rad/s for a draw of the Gaussian."""
        return self._low + 0.5 * (jnp.tanh(raw) + 1.0) * (self._high - self._low)

    def act(self, policy: Policy, stack: Float[Array, "*batch frames obs"]) -> Float[Array, "*batch action"]:
        """Returns the deterministic action, the centre of the distribution."""
        parameters = self.parameters(policy.weights, policy.statistics, stack)
        return self.action(parameters[..., : self.n_action])

    def _with_sight(self, body: MLP) -> Any:
        return body if self.layout.image is None else Seeing(self.layout.image, body)

    def _see(self, stack: Array, statistics: learning.Statistics) -> tuple[Array, ...]:
        """Returns the inputs of the networks: numbers normalised, but an image in its own scale."""
        normalized, layout = learning.normalize(stack, statistics), self.layout
        if layout.image is None:
            return (normalized.reshape(*stack.shape[:-2], -1),)
        begin, end = layout.image_at, layout.image_at + layout.image[0] * layout.image[1]
        plain = jnp.concatenate([normalized[..., :begin], normalized[..., end:]], axis=-1)
        return plain, stack[..., begin:end] / senses.IMAGE_RANGE
