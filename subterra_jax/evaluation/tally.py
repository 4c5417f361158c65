"""What the evaluation counts while an episode is driven, and what becomes of it at the end."""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.env import Info, TunnelEnv
from subterra_jax.evaluation.estimates import EstimateTally, add_estimate, start_estimates
from subterra_jax.rules import Relocalise, TurnBack
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import CONTACT_REACH


@struct.dataclass
class Tally:
    """Running sums of one episode; see `records` for what they become.

    Attributes:
        steps: Steps taken.
        travelled: Distance driven, m: the sum of the chords of the control periods.
        way: Length of the shortest way to success, m; NaN where there is no such thing.
        offset: Sum of |d| / w.
        lateral_square: Sum of d², m².
        jerk: Sum of |Δv| + |Δω|, m/s and rad/s, as the reward counts it.
        clearance: Least distance to wall or obstacle, m; beyond `CONTACT_REACH` nobody looks.
        success: The task was achieved.
        contact: It ended at a wall or an obstacle.
        goal_error: Where it stood less where it should have (of what it reported less where it stood), m.
        coverage: Share of the tunnel covered when the episode was over.
        progress: The same had it gone on to the far mouth.
        estimates: Scores of its estimate.
    """

    steps: Int[Array, ""]
    travelled: Float[Array, ""]
    way: Float[Array, ""]
    offset: Float[Array, ""]
    lateral_square: Float[Array, ""]
    jerk: Float[Array, ""]
    clearance: Float[Array, ""]
    success: Bool[Array, ""]
    contact: Bool[Array, ""]
    goal_error: Float[Array, ""]
    coverage: Float[Array, ""]
    progress: Float[Array, ""]
    estimates: EstimateTally


def start_tally(env: TunnelEnv, state: State, params: EnvParams) -> Tally:
    """An episode before its first step."""
    zero, no = jnp.zeros(()), jnp.zeros((), bool)
    return Tally(
        steps=jnp.zeros((), jnp.int32),
        travelled=zero,
        way=_way(env, state, params),
        offset=zero,
        lateral_square=zero,
        jerk=zero,
        clearance=jnp.full((), CONTACT_REACH),
        success=no,
        contact=no,
        goal_error=jnp.full((), jnp.nan),
        coverage=zero,
        progress=zero,
        estimates=start_estimates(),
    )


def add_step(
    tally: Tally,
    before: State,
    after: State,
    estimate: Float[Array, "2"],
    info: Info,
    params: EnvParams,
) -> Tally:
    """One step more.

    Args:
        tally: So far.
        before: State before the step.
        after: State after it.
        estimate: Estimated station (m; NaN from one who has none) and log of its standard deviation, as the agent said.
        info: The step's info.
        params: The task, in the tunnel that the robot is in.
    """
    moved = after.position - before.position
    change = jnp.abs(after.command - before.command)
    steps = tally.steps + 1
    tolerance = jnp.asarray(1.0 if params.goal is None else params.goal.tolerance)
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
        estimates=add_estimate(
            tally.estimates, error, info["estimate_log_sigma"], steps, tolerance, params.tunnel.ring_pitch
        ),
    )


def _way(env: TunnelEnv, state: State, params: EnvParams) -> Float[Array, ""]:
    """Shortest way to success, m: along the centreline."""
    if state.goal is None:
        return params.goal_coverage * params.tunnel.length - state.station
    if isinstance(env.rule, Relocalise):
        return jnp.full((), jnp.nan)
    there = jnp.abs(state.goal.station - state.station)
    return 2.0 * there if isinstance(env.rule, TurnBack) else there
