"""The one network of a policy, for training and for driving: perceptrons of actor and critic, a GRU where asked for.

inputs ─► (GRU) ─► actor: mean of a Gaussian before the tanh
                └► critic: return to come
                └► auxiliary head: what only the simulator knows, asked for in training
"""

import dataclasses
import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.policies.inputs import FAR, scaled_way

Weights = Any  # nested dict of arrays, as flax makes it


@dataclasses.dataclass(frozen=True)
class Shape:
    """Sizes of a network."""

    n_inputs: int  # numbers that it reads
    n_action: int  # numbers of an action
    hidden: tuple[int, ...]  # widths of the hidden layers of actor and critic
    cell: int = 0  # width of the GRU; 0 has none
    # place in the inputs of the way to go over `inputs.FAR`, which the auxiliary head corrects; None has no such head
    way_at: int | None = None
    init_std: float = 0.5  # standard deviation of the untrained policy before the tanh
    n_seen: int = 0  # Inputs that the actor sees; the critic sees all. 0 is all.
    init_turn: float | None = None  # the same for its second number, the yaw rate; None is `init_std`

    @property
    def spread(self) -> np.ndarray:
        """Standard deviations of the untrained policy before the tanh."""
        spread = np.full(self.n_action, self.init_std)
        spread[1:2] = self.init_turn or self.init_std
        return spread


@struct.dataclass
class Outputs:
    """Answers of the network."""

    mean: Float[Array, "*batch action"]  # mean of the Gaussian before the tanh
    log_std: Float[Array, "action"]  # log of its standard deviation
    value: Float[Array, "*batch"]  # return to come, in units of the reward scale
    # error of the reckoned way to go, m, and log of its scale, by the auxiliary head; no numbers without one
    error: Float[Array, "*batch n"]


class Cell(nn.Module):
    """Gated recurrent unit whose inputs are projected for all steps at once. Source: Cho et al. 2014."""

    width: int  # numbers that it keeps

    def setup(self) -> None:
        self.of_input = nn.Dense(3 * self.width)
        self.of_memory = nn.Dense(3 * self.width, use_bias=False)

    def __call__(self, x: Float[Array, "*batch n"], memory: Float[Array, "*batch cell"]) -> Float[Array, "*batch cell"]:
        return self._turn(self.of_input(x), memory)

    def unroll(
        self, x: Float[Array, "time env n"], memory: Float[Array, "env cell"], first: Bool[Array, "time env"]
    ) -> Float[Array, "time env cell"]:
        """Returns the memory after every step; it begins anew where `first`."""
        projected = self.of_input(x)
        kernel = self.of_memory.variables["params"]["kernel"]

        def step(memory: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
            of_input, begins = now
            memory = jnp.where(begins[:, None], 0.0, memory)
            after = _gates(of_input, memory @ kernel, memory)
            return after, after

        return jax.lax.scan(step, memory, (projected, first), unroll=4)[1]

    def _turn(self, of_input: Array, memory: Array) -> Array:
        return _gates(of_input, self.of_memory(memory), memory)


def _gates(of_input: Array, of_memory: Array, memory: Array) -> Array:
    reset_x, keep_x, new_x = jnp.split(of_input, 3, axis=-1)
    reset_h, keep_h, new_h = jnp.split(of_memory, 3, axis=-1)
    keep = jax.nn.sigmoid(keep_x + keep_h + 1.0)
    return keep * memory + (1.0 - keep) * jnp.tanh(new_x + jax.nn.sigmoid(reset_x + reset_h) * new_h)


class Perceptron(nn.Module):
    """Hidden layers and an output layer."""

    widths: tuple[int, ...]  # widths of all layers, the output last
    scale: float  # scale of the untrained output layer

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n"]) -> Float[Array, "*batch out"]:
        for i, width in enumerate(self.widths[:-1]):
            kernel = nn.initializers.orthogonal(math.sqrt(2.0))
            x = nn.swish(nn.Dense(width, kernel_init=kernel, name=f"hidden_{i}")(x))
        last = nn.initializers.orthogonal(self.scale)
        return nn.Dense(self.widths[-1], kernel_init=last, name="out")(x)


class Network(nn.Module):
    """Actor, critic and auxiliary head behind one optional memory."""

    shape: Shape  # its sizes

    def setup(self) -> None:
        shape = self.shape
        self.actor = Perceptron((*shape.hidden, shape.n_action), 0.01)
        self.critic = Perceptron((*shape.hidden, 1), 1.0)
        self.log_std = self.param("log_std", lambda key: jnp.asarray(np.log(shape.spread), jnp.float32))
        if shape.cell:
            self.cell = Cell(shape.cell)
        if shape.way_at is not None:
            self.head = Perceptron((shape.hidden[-1], 2), 0.1)

    def __call__(self, x: Float[Array, "*batch n"], memory: Any) -> tuple[Outputs, Any]:
        """Returns the answers to one step, and the GRU's memory after it; unchanged without one."""
        if self.shape.cell:
            memory = self.cell(x, memory)
        return self._answer(x, memory), memory

    def unroll(self, x: Float[Array, "time env n"], memory: Any, first: Bool[Array, "time env"]) -> Outputs:
        """Returns the answers to every step of a rollout; `first` where an episode begins."""
        if self.shape.cell:
            memory = self.cell.unroll(x, memory, first)
        return self._answer(x, memory)

    def _answer(self, x: Array, memory: Any) -> Outputs:
        shape = self.shape
        known = jnp.concatenate([x, memory], axis=-1) if shape.cell else x
        error = jnp.zeros((*x.shape[:-1], 0))
        if shape.way_at is not None:
            error = self.head(known)
            # The head learns by its target alone; actor and critic read what it says.
            fixed = jax.lax.stop_gradient(error)
            way = FAR * x[..., shape.way_at] + fixed[..., 0]
            known = jnp.concatenate([known, scaled_way(way), fixed[..., 1:]], axis=-1)
        seen = known[..., : shape.n_seen] if shape.n_seen else known
        return Outputs(self.actor(seen), self.log_std, self.critic(known)[..., 0], error)


def start_memory(shape: Shape, batch: tuple[int, ...]) -> Float[Array, "*batch cell"]:
    """Returns the GRU's memory at the start of an episode; it has no numbers without a GRU."""
    return jnp.zeros((*batch, shape.cell))


def init(shape: Shape, key: Any) -> Weights:
    """Returns untrained weights."""
    return Network(shape).init(key, jnp.zeros((1, shape.n_inputs)), start_memory(shape, (1,)))["params"]


def act(actor: Weights, x: Float[Array, "*batch n"]) -> Float[Array, "*batch action"]:
    """Returns what an actor alone answers: the mean before the tanh.

    Args:
        actor: Weights of a `Perceptron`, layers by name.
    """
    hidden = [actor[f"hidden_{i}"]["bias"].shape[0] for i in range(len(actor) - 1)]
    widths = (*hidden, actor["out"]["bias"].shape[0])
    mean: Any = Perceptron(widths, 1.0).apply({"params": actor}, x)
    return mean


def to_action(
    raw: Float[Array, "*batch action"], low: Float[Array, "action"], high: Float[Array, "action"], standing: float
) -> Float[Array, "*batch action"]:
    """Returns the action of a draw of the Gaussian, within its bounds, m/s and rad/s.

    A range that begins at 0 is stretched below it by a fraction `standing` of its end, and clipped: to stand is then a
    region and not the limit of a tanh.
    """
    lowest = jnp.where(low == 0.0, -standing * high, low)
    return jnp.clip(lowest + 0.5 * (jnp.tanh(raw) + 1.0) * (high - lowest), low, high)
