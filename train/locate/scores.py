"""Errors of a localiser by kind of lining, over drives as an agent makes them: what a stop at a goal would miss by."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from subterra_jax import constants
from subterra_jax.policies import load
from subterra_jax.policies.locate import map_filter
from subterra_jax.policies.locate.agent import Locating
from subterra_jax.policies.locate.map_strip import MapStrip
from train.config import ConfigError
from train.locate.drives import Drive, record_drives
from train.locate.learner import Told, believe, estimate

FIRST = 60  # m, the nearest goal
_WAY = 350.0  # m, commanded: the farthest goal and what slip adds
_BATCH = 16
FARTHEST = 320  # m, the farthest goal

WITH_MAP = ("mapped", "hidden", "hidden_mapped", "misled")

Found = dict[str, np.ndarray]


def open_localiser(name: str) -> Locating:
    """Opens a policy that is a localiser: a released one, a file, or a run folder.

    Raises:
        ConfigError: It is another policy.
        SubterraError: There is no such policy.
    """
    agent, _ = load(name)
    if not isinstance(agent, Locating):
        raise ConfigError(f"{name}: is no localiser, but {type(agent).__name__}")
    return agent


def record(env: Any, params: Any, key: PRNGKeyArray, n: int, last: int = FARTHEST, speed: float | None = None) -> Drive:
    """Drives `n` robots from where the task starts for `last` m, at `speed`, m/s, or the vehicle's."""
    steps = steps_of(params, speed, last)
    drive = jax.jit(lambda key: record_drives(env, params, key, n, steps, from_mouth=True, speed=speed))
    return drive(key)


def steps_of(params: Any, speed: float | None, last: int = FARTHEST) -> int:
    """Returns the steps that `last` m and what slip adds take at `speed`, m/s; None is the vehicle's."""
    each = float(params.vehicle.period) * float(params.vehicle.speed_max if speed is None else speed)
    return int(np.ceil(_WAY / each * last / FARTHEST - 1e-6))


def make_judge(network: str, last: int = FARTHEST) -> Callable[..., dict[str, Array]]:
    """Compiles a function of weights, recorded drives and, for a network that takes one, the maps of their tunnels.

    Args:
        network: Name of the memory.
        last: Farthest goal, m.

    Returns:
        Of each drive `within` (share of goals from 60 to `last` m at which the estimate is right to 1 m), `error`
        (median, m), `claimed` (mean absolute error that it claims at the end, m), `found` (error there, m), all `(n,)`.
        A drive that comes less than 60 m far has no goal, and `within` of NaN. With maps also the share of right
        estimates with the map (`mapped`), with a hidden start and no map (`hidden`), with a hidden start and the map
        (`hidden_mapped`), and with a map of another place (`misled`).
    """
    goals = jnp.arange(last) >= min(FIRST, last // 2) - 1

    @jax.jit
    def judge(weights: Any, drives: Drive, strip: MapStrip | None = None) -> dict[str, Array]:
        def errors(drive: Drive) -> dict[str, Array]:
            answers, truth, valid = estimate(network, weights, drive, last)
            error, use = jnp.abs(answers.correction - truth), goals & valid
            end = jnp.maximum(jnp.sum(valid) - 1, 0)
            mapped = {} if strip is None else with_map(weights, drive, answers, truth, use, strip)
            return {
                **mapped,
                "within": jnp.sum(use & (error <= 1.0)) / jnp.sum(use),
                "error": jnp.nanmedian(jnp.where(use, error, jnp.nan)),
                "claimed": jnp.exp(answers.log_scale[end]),
                "found": error[end],
            }

        return jax.lax.map(errors, drives, batch_size=_BATCH)

    return judge


def with_map(weights: Any, drive: Drive, answers: Any, truth: Array, use: Array, strip: MapStrip) -> dict[str, Array]:
    """Returns the shares of right estimates of one drive with a map, a hidden start, or a wrong map."""
    age, zero = jnp.arange(1.0, len(truth) + 1.0), jnp.zeros(())
    # Drawn from the start itself, so that the same drive is told the same at every score.
    key = jax.random.key(jax.lax.bitcast_convert_type(drive.start, jnp.uint32))
    drawn = constants.HIDDEN_START_SIGMA * jnp.clip(jax.random.normal(key), -3.0, 3.0)
    hidden = jnp.full((), constants.HIDDEN_START_SIGMA)
    other = (drive.tunnel + 1) % strip.n_bins.shape[0]
    right = jnp.array([True, True, False])
    cases = Told(
        offset=jnp.stack([zero, drawn, zero]),
        sigma=jnp.stack([zero, hidden, zero]),
        tunnel=jnp.where(right, drive.tunnel, other),
        shift=jnp.zeros(3),
        right=right,
    )

    def share(told: Told) -> Array:
        beliefs, _ = believe(weights, drive, told, answers, strip)
        better = jax.vmap(map_filter.corrected, (0, 0, 0, None))(beliefs, answers, age, told.sigma)
        return jnp.sum(use & (jnp.abs(better.correction - truth - told.offset) <= 1.0)) / jnp.sum(use)

    mapped, hidden_mapped, misled = jax.vmap(share)(cases)
    alone = jnp.sum(use & (jnp.abs(answers.correction - truth - drawn) <= 1.0)) / jnp.sum(use)
    return {"mapped": mapped, "hidden": alone, "hidden_mapped": hidden_mapped, "misled": misled}


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
