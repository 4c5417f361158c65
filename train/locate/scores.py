"""Errors of a localiser by kind of lining, over drives from the mouth: what a stop at any goal would miss by."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from train.locate.drives import record_drives
from train.locate.learner import estimate

_FIRST, _STEPS = 60, 1750  # m, the nearest goal; steps, 320 m and what slip adds
_BATCH = 64


def score(
    network: str, weights: Any, env: Any, params: Any, key: PRNGKeyArray, n: int, last: int = 320
) -> dict[str, np.ndarray]:
    """Drives `n` robots from the mouth at full speed.

    Returns:
        `within` (share of goals from 60 to `last` m at which the estimate is right to 1 m), `error` (median, m),
        `claimed` (mean absolute error that it claims at the end, m) and `found` (mean absolute error there), with the
        number of each robot's `tunnel`, all `(n,)`.
    """
    steps = int(np.ceil(_STEPS * last / 320))
    network_name, goals = network, jnp.arange(last) >= _FIRST - 1

    @jax.jit
    def drive(key: PRNGKeyArray) -> Any:
        return record_drives(env, params, key, min(n, _BATCH), steps, from_mouth=True)

    @jax.jit
    def one(weights: Any, drives: Any) -> dict[str, Array]:
        def errors(drive: Any) -> dict[str, Array]:
            answers, truth, valid = estimate(network_name, weights, drive, last)
            error, use = jnp.abs(answers.correction - truth), goals & valid
            count = jnp.maximum(jnp.sum(use), 1)
            return {
                "within": jnp.sum(use & (error <= 1.0)) / count,
                "error": jnp.nanmedian(jnp.where(use, error, jnp.nan)),
                "claimed": jnp.exp(answers.log_scale[-1]),
                "found": error[-1],
            }

        return {**jax.lax.map(errors, drives, batch_size=16), "tunnel": drives.tunnel}

    rows = []
    for index in range(-(-n // _BATCH)):
        rows.append(jax.device_get(one(weights, drive(jax.random.fold_in(key, index)))))
    return {name: np.concatenate([row[name] for row in rows])[:n] for name in rows[0]}


def by_kind(found: dict[str, np.ndarray], names: list[str]) -> dict[str, dict[str, float]]:
    """Returns the means by kind of lining (medians of `error`), and over all of them as `all`."""
    kinds = np.array([kind_of(name) for name in names])[found["tunnel"].astype(int)]
    table = {}
    for kind in (*dict.fromkeys(kinds.tolist()), "all"):
        rows = kinds == kind if kind != "all" else np.ones(len(kinds), bool)
        table[kind] = {
            name: float((np.median if name == "error" else np.mean)(values[rows]))
            for name, values in found.items()
            if name != "tunnel"
        }
    return table


def kind_of(name: str) -> str:
    """Returns the kind in a tunnel's name, or the name itself."""
    parts = name.split(":")
    return parts[1] if parts[0] == "open" and len(parts) == 4 else name
