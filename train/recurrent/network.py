"""A GRU with two heads (action and position) and a critic that sees the truth."""

import dataclasses
import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.policies import senses
from subterra_jax.policies.senses import PLAIN, Senses
from train.learning import MLP, NormalTanhDistribution, glance

Weights = Any


@dataclasses.dataclass(frozen=True)
class RecurrentLayout:
    """Shapes of all arrays and meaning of the outputs; a checkpoint carries it.

    Attributes:
        n_features: Inputs of the network.
        n_truth: Inputs of the critic.
        action_low: Smallest action, m/s and rad/s.
        action_high: Largest action, m/s and rad/s.
        hidden: Width of the GRU and of the layers around it.
        bins: Bins of the estimation head.
        bin_width: Their width, m.
        init_std: Standard deviation of the untrained policy before the tanh.
        min_std: Its floor.
        senses: Version of its inputs.
        tracker: Ring counter whose count it sees.
        boxes: It sees the boxes that are remembered.
        image: Rows and columns of the image that the last features are; None without one.
        half: Image and memory are computed in 16 bits while it learns.
    """

    n_features: int
    n_truth: int
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    hidden: int
    bins: int
    bin_width: float
    init_std: float
    min_std: float
    senses: int = senses.VERSION
    tracker: str = PLAIN.tracker
    boxes: bool = PLAIN.boxes
    image: tuple[int, int] | None = None
    half: bool = False

    @property
    def shown(self) -> Senses:
        """Its inputs."""
        return Senses(self.tracker, self.boxes)


@struct.dataclass
class Kept:
    """Inputs of the network as a rollout keeps them, the image apart.

    Attributes:
        plain: All but the image.
        image: Ranges over 30 m, row by row, in 16 bits if the network computes in these; None without an image.
    """

    plain: Float[Array, "*batch n"]
    image: Float[Array, "*batch pixels"] | None


class Memory(nn.Module):
    """A dense layer and a GRU over time; the hidden state is cleared where an episode begins.

    An image is first seen patch by patch, then as a whole. With `half` all products are of bfloat16 numbers.
    """

    hidden: int
    image: tuple[int, int] | None = None
    half: bool = False

    @nn.compact
    def __call__(
        self,
        kept: Kept,
        state: Float[Array, "env hidden"],
        first: Bool[Array, "time env"],
    ) -> tuple[Float[Array, "env hidden"], Float[Array, "time env hidden"]]:
        """Returns the last hidden state, and that of every step."""
        number = jnp.bfloat16 if self.half else kept.plain.dtype
        features = kept.plain.astype(number)
        if self.image is not None and kept.image is not None:
            features = jnp.concatenate([features, glance(kept.image, self.image, number)], axis=-1)
        encoded = nn.swish(nn.Dense(self.hidden, dtype=number)(features))
        # All that does not wait for the state before is done for the whole sequence at once.
        gates = nn.Dense(3 * self.hidden, dtype=number)(encoded)
        weight = self.param("recurrent", nn.initializers.orthogonal(), (self.hidden, 3 * self.hidden)).astype(number)

        def step(before: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
            gate, begins = now
            before = jnp.where(begins[:, None], 0.0, before)
            own = (before.astype(number) @ weight).astype(before.dtype)
            given, held = jnp.split(gate.astype(before.dtype), 3, axis=-1), jnp.split(own, 3, axis=-1)
            reset, update = nn.sigmoid(given[0] + held[0]), nn.sigmoid(given[1] + held[1] + 1.0)
            fresh = jnp.tanh(given[2] + reset * held[2])
            after = update * before + (1.0 - update) * fresh
            return after, after

        return jax.lax.scan(step, state, (gates, first))


@dataclasses.dataclass(frozen=True)
class Thought:
    """Outputs of the heads for a step.

    Attributes:
        parameters: Of the action distribution, before the tanh.
        logits: Of the bins of true less tracked distance.
        error: Expected true less tracked distance, m.
        log_sigma: Log of its standard deviation, m.
    """

    parameters: Float[Array, "*batch p"]
    logits: Float[Array, "*batch bins"]
    error: Float[Array, "*batch"]
    log_sigma: Float[Array, "*batch"]


class RecurrentNetworks:
    """The network of a layout; its weights are `memory`, `estimate`, `policy` and `critic`."""

    kind = "gru"

    def __init__(self, layout: RecurrentLayout) -> None:
        self.layout = layout
        n_action = len(layout.action_low)
        self.n_action = n_action
        self.distribution = NormalTanhDistribution(n_action, min_std=layout.min_std)
        self._memory: Any
        self._estimate: Any
        self._memory, self._estimate = Memory(layout.hidden, layout.image, layout.half), nn.Dense(layout.bins)
        self._policy = MLP(
            layer_sizes=(layout.hidden, self.distribution.param_size),
            activation=jax.nn.swish,
            output_kernel_init=jax.nn.initializers.variance_scaling(1e-4, "fan_in", "uniform"),
        )
        self._critic = MLP(layer_sizes=(layout.hidden, layout.hidden, 1), activation=jax.nn.swish)
        self._low, self._high = jnp.asarray(layout.action_low), jnp.asarray(layout.action_high)
        spread = math.log(math.expm1(layout.init_std - layout.min_std))
        self._offset = jnp.concatenate([jnp.zeros(n_action), jnp.full(n_action, spread)])
        self.centres = senses.bin_centres(layout.bins, layout.bin_width)

    def init(self, key: PRNGKeyArray) -> dict[str, Weights]:
        """Returns untrained weights."""
        keys = jax.random.split(key, 4)
        layout = self.layout
        hidden = jnp.zeros((1, 1, layout.hidden))
        features = jnp.zeros((1, 1, layout.n_features))
        return {
            "memory": self._memory.init(keys[0], self.keep(features), hidden[0], jnp.zeros((1, 1), bool)),
            "estimate": self._estimate.init(keys[1], hidden),
            "policy": self._policy.init(keys[2], jnp.zeros((1, layout.hidden + senses.N_AIM))),
            "critic": self._critic.init(keys[3], jnp.zeros((1, layout.n_truth))),
        }

    def policy_shapes(self) -> dict[str, Weights]:
        """Returns a policy, the weights but the critic's, with shapes in place of arrays."""
        return without_critic(jax.eval_shape(self.init, jax.random.key(0)))

    def keep(self, features: Float[Array, "*batch n"] | Kept) -> Kept:
        """Returns the inputs as a rollout keeps them; pixels that are not apart yet are the last."""
        if not isinstance(features, Kept):
            n_pixels = math.prod(self.layout.image or (0,))
            n_plain = features.shape[-1] - n_pixels
            features = Kept(features[..., :n_plain], features[..., n_plain:] if n_pixels else None)
        if features.image is None or not self.layout.half:
            return features
        return Kept(features.plain, features.image.astype(jnp.bfloat16))

    def remember(
        self, weights: dict[str, Weights], features: Array | Kept, state: Array, first: Array
    ) -> tuple[Float[Array, "env hidden"], Float[Array, "time env hidden"]]:
        """Returns the last hidden state, and those over time."""
        return self._memory.apply(weights["memory"], self.keep(features), state, first)

    def think(
        self, weights: dict[str, Weights], hidden: Float[Array, "*batch hidden"], ahead: Float[Array, "*batch"]
    ) -> Thought:
        """Applies the heads.

        Args:
            weights: Weights.
            hidden: Hidden states.
            ahead: Goal less tracked distance, m.
        """
        logits = self._estimate.apply(weights["estimate"], hidden)
        share = jax.nn.softmax(logits)
        error = jnp.sum(share * self.centres, axis=-1)
        spread = jnp.sum(share * jnp.square(self.centres - error[..., None]), axis=-1)
        log_sigma = 0.5 * jnp.log(spread + self.layout.bin_width**2 / 12.0)
        # The policy aims with the estimate but must not bend it to its own ends.
        aim = senses.aim(jax.lax.stop_gradient(ahead - error), jax.lax.stop_gradient(log_sigma))
        parameters = self._policy.apply(weights["policy"], jnp.concatenate([hidden, aim], axis=-1)) + self._offset
        return Thought(parameters, logits, error, log_sigma)

    def value(self, weights: dict[str, Weights], truth: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
        """Estimates the return, in units of the reward scale."""
        return self._critic.apply(weights["critic"], truth)[..., 0]

    def action(self, raw: Float[Array, "*batch action"]) -> Float[Array, "*batch action"]:
        """Returns the action in m/s and rad/s for a draw of the Gaussian."""
        return self._low + 0.5 * (jnp.tanh(raw) + 1.0) * (self._high - self._low)


def without_critic(weights: dict[str, Weights]) -> dict[str, Weights]:
    """Returns the weights that make up a policy."""
    return {name: part for name, part in weights.items() if name != "critic"}


def estimation_loss(
    logits: Float[Array, "*batch bins"], error: Float[Array, "*batch"], width: float
) -> Float[Array, "*batch"]:
    """Computes the cross entropy, the truth shared between its two nearest bins, whose middles lie evenly about 0.

    Args:
        logits: Of the bins.
        error: True less reckoned distance, m; beyond the last bin it counts as in the last.
        width: Of a bin, m.
    """
    bins = logits.shape[-1]
    place = jnp.clip(error / width + 0.5 * (bins - 1), 0.0, bins - 1.001)
    lower = jnp.floor(place).astype(jnp.int32)
    share = (place - lower)[..., None]
    log_share = jax.nn.log_softmax(logits)
    low = jnp.take_along_axis(log_share, lower[..., None], axis=-1)
    high = jnp.take_along_axis(log_share, lower[..., None] + 1, axis=-1)
    return -((1.0 - share) * low + share * high)[..., 0]
