"""Running sums of episodes, their records, and the summary: means, intervals, the area under faults."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.scipy.stats import norm
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.episode import Taken
from subterra_jax.evaluation.episodes import Episodes
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import CONTACT_REACH
from subterra_jax.tunnel_env import TunnelEnv

N_RESAMPLES = 2000
_MEANS = (
    "coverage", "progress", "spl", "clearance", "offset", "lateral", "time", "jerk", "axial_rms", "drift",
    "time_to_lock", "crps", "nees",
)  # fmt: skip
_SIZES = ("goal_error", "axial_final")  # whose mean would hide it


@dataclasses.dataclass(frozen=True)
class Records:
    """Results of `n` episodes; NaN where a quantity does not apply, as estimates of an agent that makes none.

    Attributes:
        seed: Seed of the episode.
        tunnel: Number of the tunnel in a stack.
        severity: Severity of the faults.
        group: Stratum of the bootstrap.
        success: Whether the task was achieved.
        contact: Whether it ended at a wall or an obstacle.
        coverage: Fraction of the tunnel covered, as the paper counts it: the episode ends at the goal's fraction.
        progress: The same, had the agent gone on to the far mouth: not cut off at success.
        spl: Success weighted by path length, 0 to 1.
        travelled: Distance driven, m.
        contacts_per_100m: Contacts for each 100 m driven.
        clearance: Least distance from the robot's middle to wall or obstacle, m; 0.8 where it was never nearer.
        offset: Mean |d| / w.
        lateral: Root mean square distance from the centreline, m.
        time: Duration, s.
        jerk: Mean |Δv| + |Δω| of a step, m/s and rad/s.
        goal_error: Station at the end less the one asked for, m; of a report, report less truth.
        axial_final: Last error of the estimated station, m.
        axial_rms: Root mean square error of the estimated station, m.
        drift: |axial_final| in % of the distance driven.
        time_to_lock: Time from which the estimate stayed within the task's tolerance (1 m where it has none), s; NaN
            where it was not within it at the end.
        crps: Mean continuous ranked probability score of the estimate, m.
        nees: Mean squared error over claimed variance; 1 from one who knows how well it knows.

    Source: SPL is Anderson et al. 2018, On Evaluation of Embodied Navigation Agents.
    """

    seed: Int[np.ndarray, " n"]
    tunnel: Int[np.ndarray, " n"]
    severity: Int[np.ndarray, " n"]
    group: Int[np.ndarray, " n"]
    success: Bool[np.ndarray, " n"]
    contact: Bool[np.ndarray, " n"]
    coverage: Float[np.ndarray, " n"]
    progress: Float[np.ndarray, " n"]
    spl: Float[np.ndarray, " n"]
    travelled: Float[np.ndarray, " n"]
    contacts_per_100m: Float[np.ndarray, " n"]
    clearance: Float[np.ndarray, " n"]
    offset: Float[np.ndarray, " n"]
    lateral: Float[np.ndarray, " n"]
    time: Float[np.ndarray, " n"]
    jerk: Float[np.ndarray, " n"]
    goal_error: Float[np.ndarray, " n"]
    axial_final: Float[np.ndarray, " n"]
    axial_rms: Float[np.ndarray, " n"]
    drift: Float[np.ndarray, " n"]
    time_to_lock: Float[np.ndarray, " n"]
    crps: Float[np.ndarray, " n"]
    nees: Float[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.seed)

    def where(self, chosen: Bool[np.ndarray, " n"]) -> "Records":
        return Records(**{field.name: getattr(self, field.name)[chosen] for field in dataclasses.fields(self)})


def make_records(tally: Any, episodes: Episodes, env: TunnelEnv, params: EnvParams) -> Records:
    """Make records of the `Tally` of finished episodes, fetched to the host."""
    steps, period = np.maximum(tally.steps, 1), float(np.max(params.vehicle.period))
    travelled, found = tally.travelled.astype(float), tally.estimates
    per_metre = _over(np.ones(len(episodes)), travelled)
    covers = env.rule.goal_kind == "cover"
    error = found.error.astype(float)
    estimated = ~np.isnan(found.square)
    locked = estimated & (found.unlocked < tally.steps)
    nothing = np.full(len(episodes), np.nan)
    return Records(
        **dataclasses.asdict(episodes),
        success=tally.success,
        contact=tally.contact,
        coverage=tally.coverage.astype(float) if covers else nothing,
        progress=tally.progress.astype(float) if covers else nothing,
        spl=np.where(np.isnan(tally.way), np.nan, tally.success * _over(tally.way, np.maximum(tally.way, travelled))),
        travelled=travelled,
        contacts_per_100m=100.0 * tally.contact * per_metre,
        clearance=tally.clearance.astype(float),
        offset=tally.offset / steps,
        lateral=np.sqrt(tally.lateral_square / steps),
        time=tally.steps * period,
        jerk=tally.jerk / steps,
        goal_error=tally.goal_error.astype(float),
        axial_final=np.where(estimated, error, np.nan),
        axial_rms=np.sqrt(found.square / steps),
        drift=100.0 * np.abs(np.where(estimated, error, np.nan)) * per_metre,
        time_to_lock=np.where(locked, found.unlocked * period, np.nan),
        crps=found.crps / steps,
        nees=found.nees / steps,
    )


def _over(value: np.ndarray, divisor: np.ndarray) -> np.ndarray:
    """Divide; NaN where one would divide by 0."""
    return np.where(divisor > 0.0, value / np.where(divisor > 0.0, divisor, 1.0), np.nan)


def summarise(records: Records, seed: int = 0) -> dict[str, Any]:
    """Summarise the records of one agent on one task, as plain values; None where a quantity does not apply.

    Args:
        records: Records of its episodes.
        seed: Seed of the bootstrap.

    Returns:
        `episodes`; `success`, the mean; the ends `success_low` and `success_high` of the 95 % interval of the mean;
        `contacts_per_100m` over all episodes together; means of the rest of the record's quantities (of `goal_error`
        and `axial_final` the mean size), and of `nees` the median too; with several severities `success_by_severity`
        and `success_area` under it.
    """
    groups = grouped(records.success.astype(float), records.group)
    low, high = interval(groups, lambda scores: scores.mean(axis=(-2, -1)), seed)
    travelled = records.travelled.sum()
    found: dict[str, Any] = {
        "episodes": len(records),
        "success": float(records.success.mean()),
        "success_low": low,
        "success_high": high,
        "contacts_per_100m": float(100.0 * records.contact.sum() / travelled) if travelled > 0.0 else None,
    }
    found |= {name: _mean(getattr(records, name)) for name in _MEANS}
    found |= {name: _mean(np.abs(getattr(records, name))) for name in _SIZES}
    found["nees_median"] = _mean(np.atleast_1d(np.median(records.nees)))
    severities = np.unique(records.severity)
    if len(severities) > 1:
        by_severity = [float(records.success[records.severity == s].mean()) for s in severities]
        found["success_by_severity"] = dict(zip(severities.tolist(), by_severity, strict=True))
        found["success_area"] = area(severities.astype(float), np.array(by_severity))
    return found


def _mean(values: Float[np.ndarray, " n"]) -> float | None:
    valid = values[~np.isnan(values)]
    return float(valid.mean()) if len(valid) else None


def grouped(values: Float[np.ndarray, " n"], group: Int[np.ndarray, " n"]) -> Float[np.ndarray, "groups size"]:
    """Group values, one row each; groups larger than the smallest lose their last values."""
    rows = [values[group == g] for g in np.unique(group)]
    size = min(len(row) for row in rows)
    return np.stack([row[:size] for row in rows])


def interval(
    scores: Float[np.ndarray, "strata size"],
    statistic: Callable[[np.ndarray], np.ndarray],
    seed: int = 0,
    level: float = 0.95,
) -> tuple[float, float]:
    """Compute the percentile interval of a statistic by the stratified bootstrap.

    Args:
        scores: Values, one row for each stratum; each row is drawn from by itself.
        statistic: From `(resamples, strata, size)` to `(resamples,)`.
        seed: Seed of the draws: the same scores give the same interval.
        level: Confidence.

    Source: Agarwal et al. 2021, Deep Reinforcement Learning at the Edge of the Statistical Precipice.
    """
    strata, size = scores.shape
    index = np.random.default_rng(seed).integers(size, size=(N_RESAMPLES, strata, size))
    drawn = statistic(scores[np.arange(strata)[None, :, None], index])
    low, high = np.quantile(drawn, [0.5 - level / 2.0, 0.5 + level / 2.0])
    return float(low), float(high)


def area(severity: Float[np.ndarray, " n"], success: Float[np.ndarray, " n"]) -> float:
    """Compute the area under success against severity, 0 to 1, by trapezia."""
    return float(np.trapezoid(success, severity) / (severity[-1] - severity[0]))


@struct.dataclass
class EstimateTally:
    """Scores of an estimate of the station: running sums over the steps of an episode."""

    error: Float[Array, ""]  # last error, estimate less truth, m
    square: Float[Array, ""]  # sum of squared errors, m²
    crps: Float[Array, ""]  # sum of the continuous ranked probability scores, m
    nees: Float[Array, ""]  # sum of squared errors over claimed variances, 1
    unlocked: Int[Array, ""]  # last step after which the error was beyond the tolerance; 0 for never


@struct.dataclass
class Tally:
    """Running sums of one episode; see `records` for what they become."""

    steps: Int[Array, ""]  # steps taken
    travelled: Float[Array, ""]  # distance driven, m: the sum of the chords of the control periods
    way: Float[Array, ""]  # length of the shortest way to success, m; NaN where there is no such thing
    offset: Float[Array, ""]  # sum of |d| / w
    lateral_square: Float[Array, ""]  # sum of d², m²
    jerk: Float[Array, ""]  # sum of |Δv| + |Δω|, m/s and rad/s, as the reward counts it
    clearance: Float[Array, ""]  # least distance to wall or obstacle, m; beyond `CONTACT_REACH` nobody looks
    success: Bool[Array, ""]  # the task was achieved
    contact: Bool[Array, ""]  # it ended at a wall or an obstacle
    # where it stood less where it should have (of what it reported less where it stood), m
    goal_error: Float[Array, ""]
    coverage: Float[Array, ""]  # fraction of the tunnel covered when the episode was over
    progress: Float[Array, ""]  # fraction covered had the robot gone on to the far mouth
    over: Bool[Array, ""]  # the episode is over as published; what comes after only counts as progress
    estimates: EstimateTally  # scores of its estimate


def start_tally(env: TunnelEnv, state: State, here: EnvParams) -> Tally:
    """Begin the sums of an episode; `here` are the params of its tunnel and severity."""
    zero, no = jnp.zeros(()), jnp.zeros((), bool)
    return Tally(
        steps=jnp.zeros((), jnp.int32),
        travelled=zero,
        way=jnp.asarray(env.rule.shortest_way(state, here.tunnel, here), jnp.float32),
        offset=zero,
        lateral_square=zero,
        jerk=zero,
        clearance=jnp.full((), CONTACT_REACH),
        success=no,
        contact=no,
        goal_error=jnp.full((), jnp.nan),
        coverage=zero,
        progress=zero,
        over=no,
        estimates=start_estimates(),
    )


def add_step(tally: Tally, taken: Taken, tolerance: Float[Array, ""]) -> Tally:
    """Add one step; an estimate within the tolerance, m, counts as right."""
    info, estimate = taken.info, taken.action[2:4]
    moved = taken.after.position - taken.before.position
    change = jnp.abs(taken.after.command - taken.before.command)
    steps = tally.steps + 1
    error = jnp.where(jnp.isnan(estimate[0]), jnp.nan, info["estimate_error"])
    return dataclasses.replace(
        tally,
        steps=steps,
        travelled=tally.travelled + jnp.sqrt(moved[0] * moved[0] + moved[1] * moved[1]),
        offset=tally.offset + jnp.abs(info["lateral"]) / info["half_width"],
        lateral_square=tally.lateral_square + info["lateral"] ** 2,
        jerk=tally.jerk + change[0] + change[1],
        clearance=jnp.minimum(tally.clearance, info["clearance"]),
        success=info["success"],
        contact=info["contact"],
        goal_error=info.get("goal_error", tally.goal_error),
        coverage=info["coverage"],
        estimates=add_estimate(tally.estimates, error, info["estimate_log_sigma"], steps, jnp.asarray(tolerance)),
    )


def start_estimates() -> EstimateTally:
    """Begin the scores of an estimate."""
    zero = jnp.zeros(())
    return EstimateTally(zero, zero, zero, zero, jnp.zeros((), jnp.int32))


def add_estimate(
    tally: EstimateTally,
    error: Float[Array, ""],
    log_sigma: Float[Array, ""],
    step: Int[Array, ""],
    tolerance: Float[Array, ""],
) -> EstimateTally:
    """Add one step, whose number counts from 1.

    Args:
        error: Estimate less truth, m; NaN makes every sum NaN, which is what no estimate scores.
        log_sigma: Log of the claimed standard deviation in m.
        tolerance: Error up to which the estimate counts as locked, m.
    """
    sigma = jnp.exp(log_sigma)
    return EstimateTally(
        error=error,
        square=tally.square + error * error,
        crps=tally.crps + crps(error, sigma),
        nees=tally.nees + (error / sigma) ** 2,
        unlocked=jnp.where(jnp.abs(error) <= tolerance, tally.unlocked, step),
    )


def crps(error: Float[Array, ""], sigma: Float[Array, ""]) -> Float[Array, ""]:
    """Compute the continuous ranked probability score of a normal distribution, m, off the truth by `error`, m.

    Source: Gneiting and Raftery 2007, Strictly Proper Scoring Rules, eq. 21.
    """
    z = error / sigma
    return sigma * (z * (2.0 * norm.cdf(z) - 1.0) + 2.0 * norm.pdf(z) - 1.0 / jnp.sqrt(jnp.pi))
