"""The few layers that trained policies are made of, on tensors by name."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

Tensors = dict[str, Float[Array, "..."]]


def dense(tensors: Tensors, name: str, x: Float[Array, "*batch n"]) -> Float[Array, "*batch m"]:
    """`x · <name>.kernel + <name>.bias`."""
    return x @ tensors[f"{name}.kernel"] + tensors[f"{name}.bias"]


def perceptron(
    tensors: Tensors, name: str, x: Float[Array, "*batch n"], activation: Callable[[Array], Array]
) -> Float[Array, "*batch m"]:
    """The layers `<name>.hidden_0`, `<name>.hidden_1`, …, with an activation between each two."""
    index = 0
    while True:
        x = dense(tensors, f"{name}.hidden_{index}", x)
        index += 1
        if f"{name}.hidden_{index}.kernel" not in tensors:
            return x
        x = activation(x)


def squash(mean: Float[Array, "*batch n"], low: Float[Array, "n"], high: Float[Array, "n"]) -> Float[Array, "*batch n"]:
    """The action in m/s and rad/s that belongs to a number before the tanh."""
    return low + 0.5 * (jnp.tanh(mean) + 1.0) * (high - low)
