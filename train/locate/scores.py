"""Errors of a localiser by kind of lining, over drives as an agent makes them: what a stop at a goal would miss by."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from train.locate.drives import Drive, record_drives
from train.locate.learner import estimate

FIRST, _STEPS = 60, 1750  # m, the nearest goal; steps, 320 m and what slip adds
_BATCH = 16
FARTHEST = 320  # m, the farthest goal

Found = dict[str, np.ndarray]


def record(env: Any, params: Any, key: PRNGKeyArray, n: int, last: int = FARTHEST) -> Drive:
    """Drives `n` robots from where the task starts, at full speed, for `last` m."""
    steps = int(np.ceil(_STEPS * last / FARTHEST))
    drive = jax.jit(lambda key: record_drives(env, params, key, n, steps, from_mouth=True))
    return drive(key)


def make_judge(network: str, last: int = FARTHEST) -> Callable[[Any, Drive], dict[str, Array]]:
    """Compiles a function of weights and recorded drives.

    Returns:
        Of each drive `within` (share of goals from 60 to `last` m at which the estimate is right to 1 m), `error`
        (median, m), `claimed` (mean absolute error that it claims at the end, m), `found` (error there, m), all `(n,)`.
        A drive that comes less than 60 m far has no goal, and `within` of NaN.
    """
    goals = jnp.arange(last) >= min(FIRST, last // 2) - 1

    @jax.jit
    def judge(weights: Any, drives: Drive) -> dict[str, Array]:
        def errors(drive: Drive) -> dict[str, Array]:
            answers, truth, valid = estimate(network, weights, drive, last)
            error, use = jnp.abs(answers.correction - truth), goals & valid
            end = jnp.maximum(jnp.sum(valid) - 1, 0)
            return {
                "within": jnp.sum(use & (error <= 1.0)) / jnp.sum(use),
                "error": jnp.nanmedian(jnp.where(use, error, jnp.nan)),
                "claimed": jnp.exp(answers.log_scale[end]),
                "found": error[end],
            }

        return jax.lax.map(errors, drives, batch_size=_BATCH)

    return judge


def by_kind(found: Found, tunnel: np.ndarray, names: list[str]) -> dict[str, dict[str, float]]:
    """Returns the means by kind of lining (medians of `error`), and over all of them as `all`.

    Args:
        found: As from a judge.
        tunnel: Number of each drive's tunnel.
        names: Names of the tunnels.
    """
    kinds = np.array([kind_of(name) for name in names])[np.asarray(tunnel).astype(int)]
    table = {}
    for kind in (*dict.fromkeys(kinds.tolist()), "all"):
        rows = kinds == kind if kind != "all" else np.ones(len(kinds), bool)
        table[kind] = {
            name: float((np.nanmedian if name == "error" else np.nanmean)(np.asarray(values)[rows]))
            for name, values in found.items()
        }
    return table


def kind_of(name: str) -> str:
    """Returns the kind in a tunnel's name, or the name itself."""
    parts = name.split(":")
    return parts[1] if parts[0] == "open" and len(parts) == 4 else name
