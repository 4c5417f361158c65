"""A transformer over the last `SPAN` metres. Source: Vaswani et al. 2017.

It turns inputs, one row a metre, into rows of hidden numbers; `sequence` does it for many metres at once, `step` for
the next one, with the same result.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

Weights = dict[str, Any]
HIDDEN = 128
SPAN = 30  # metres that attention looks back
_HEADS, _LAYERS = 4, 2


def dense(key: PRNGKeyArray, n_in: int, n_out: int, scale: float = 1.0) -> Weights:
    """Returns an untrained layer."""
    return {"kernel": scale * jax.random.normal(key, (n_in, n_out)) / np.sqrt(n_in), "bias": jnp.zeros(n_out)}


def apply(layer: Weights, x: Array) -> Array:
    """Returns `x W + b`."""
    return x @ layer["kernel"] + layer["bias"]


def _norm(x: Array) -> Array:
    mean = jnp.mean(x, axis=-1, keepdims=True)
    return (x - mean) * jax.lax.rsqrt(jnp.mean((x - mean) ** 2, axis=-1, keepdims=True) + 1e-6)


def init(key: PRNGKeyArray) -> Weights:
    """Returns untrained weights."""
    layers: Weights = {}
    for i in range(_LAYERS):
        keys = jax.random.split(jax.random.fold_in(key, i), 4)
        layers[f"layer_{i}"] = {
            "qkv": dense(keys[0], HIDDEN, 3 * HIDDEN),
            "out": dense(keys[1], HIDDEN, HIDDEN, 0.3),
            "up": dense(keys[2], HIDDEN, 2 * HIDDEN),
            "down": dense(keys[3], 2 * HIDDEN, HIDDEN, 0.3),
            "near": jnp.zeros((_HEADS, SPAN)),
        }
    return layers


def start() -> Array:
    """Returns the memory at the start: no keys and values yet; the last number is 1 where there are some."""
    return jnp.zeros((_LAYERS, SPAN, 2 * HIDDEN + 1))


def step(weights: Weights, memory: Array, x: Array) -> tuple[Array, Array]:
    """Returns the memory after a row, and the hidden numbers."""
    kept = []
    for i in range(_LAYERS):
        layer = weights[f"layer_{i}"]
        q, k, v = _project(layer, x)
        rows = jnp.concatenate([memory[i, 1:], jnp.concatenate([k, v, jnp.ones(1)])[None]])
        kept.append(rows)
        k, v, there = jnp.split(rows, [HIDDEN, 2 * HIDDEN], axis=-1)
        x = _mix(layer, x, _attend(layer, q, k, v, there[:, 0] > 0.5))
    return jnp.stack(kept), x


def sequence(weights: Weights, rows: Float[Array, "t n"]) -> Float[Array, "t n"]:
    """Returns the hidden numbers after each row."""
    index = np.arange(rows.shape[0])[:, None] + np.arange(1 - SPAN, 1)
    there, index = jnp.asarray(index >= 0), np.maximum(index, 0)
    for i in range(_LAYERS):
        layer = weights[f"layer_{i}"]
        q, k, v = _project(layer, rows)
        heard = jax.vmap(lambda q, k, v, there, layer=layer: _attend(layer, q, k, v, there))(
            q, k[index], v[index], there
        )
        rows = _mix(layer, rows, heard)
    return rows


def _project(layer: Weights, x: Array) -> tuple[Array, ...]:
    return tuple(jnp.split(apply(layer["qkv"], _norm(x)), 3, axis=-1))


def _attend(layer: Weights, q: Array, k: Array, v: Array, there: Array) -> Array:
    """Returns the mean of the values of the last rows, by head, weighted by how their keys fit the query."""
    split = lambda x: x.reshape(*x.shape[:-1], _HEADS, -1)  # noqa: E731
    score = jnp.einsum("hd,shd->hs", split(q), split(k)) / np.sqrt(HIDDEN / _HEADS) + layer["near"]
    fraction = jax.nn.softmax(jnp.where(there, score, -1e9), axis=-1)
    return jnp.einsum("hs,shd->hd", fraction, split(v)).reshape(-1)


def _mix(layer: Weights, x: Array, heard: Array) -> Array:
    x = x + apply(layer["out"], heard)
    return x + apply(layer["down"], jax.nn.gelu(apply(layer["up"], _norm(x))))
