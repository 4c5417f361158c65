"""Running sums of an episode under evaluation."""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jax.scipy.stats import norm
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.episode import Taken
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import CONTACT_REACH
from subterra_jax.tunnel_env import TunnelEnv


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
    coverage: Float[Array, ""]  # share of the tunnel covered when the episode was over
    progress: Float[Array, ""]  # share covered had the robot gone on to the far mouth
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
    """Add one step.

    Args:
        tally: Sums so far.
        taken: The step.
        tolerance: Error up to which an estimate counts as right, m.
    """
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
    """Add one step.

    Args:
        tally: Sums so far.
        error: Estimate less truth, m; NaN makes every sum NaN, which is what no estimate scores.
        log_sigma: Log of the claimed standard deviation in m.
        step: Number of the step, from 1.
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
    """Compute the continuous ranked probability score of a normal distribution, m.

    Args:
        error: Its mean less the truth, m.
        sigma: Its standard deviation, m.

    Source: Gneiting and Raftery 2007, Strictly Proper Scoring Rules, eq. 21.
    """
    z = error / sigma
    return sigma * (z * (2.0 * norm.cdf(z) - 1.0) + 2.0 * norm.pdf(z) - 1.0 / jnp.sqrt(jnp.pi))
