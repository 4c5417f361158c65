"""T1: stop at a chainage. T3 and T4 ask the same, among obstacles and under faults."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from subterra_jax import reward
from subterra_jax.rules.rule import Bounds, Rule, Step, Verdict
from subterra_jax.state import EnvParams, GoalParams, GoalState, ResetNoise, State
from subterra_jax.tunnel import Tunnel


def drawn_start(noise: ResetNoise, params: EnvParams) -> Float[Array, ""]:
    """The true start about the station that the robot believes in, m; not outside of the mouth."""
    assert noise.station is not None
    offset = params.start.station_sigma * jnp.clip(noise.station, -3.0, 3.0)
    return jnp.maximum(params.start.station + offset, 0.0)


def drawn_goal(noise: ResetNoise, tunnel: Tunnel, goal: GoalParams) -> Float[Array, ""]:
    """A chainage between the bounds, m, as far as the tunnel has them."""
    assert noise.goal is not None
    high = jnp.maximum(jnp.minimum(goal.high, tunnel.length - goal.margin), goal.margin)
    low = jnp.minimum(goal.low, high)
    return low + (high - low) * noise.goal[0]


def stood(step: Step, goal: GoalParams) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """Steps that the robot has stood, and whether that is a stop."""
    assert step.before.goal is not None
    stands = (step.motion[0] < goal.still_speed) & (jnp.abs(step.motion[1]) < goal.still_yaw)
    still = jnp.where(stands, step.before.goal.still + 1, 0).astype(jnp.int32)
    return still, (still >= goal.still_steps) & ~step.contact


def pay(
    step: Step,
    params: EnvParams,
    *,
    success: Bool[Array, ""],
    stopped: Bool[Array, ""],
    failed: Bool[Array, ""],
    error: Float[Array, ""],
    nearer: Float[Array, ""],
) -> reward.Terms:
    """The terms of `reward.goal_terms` for a step."""
    assert isinstance(params.reward, reward.GoalRewardParams)
    assert params.goal is not None
    return reward.goal_terms(
        success=success,
        stopped=stopped,
        failed=failed,
        error=error,
        tolerance=jnp.asarray(params.goal.tolerance),
        nearer=nearer,
        lateral=step.place.lateral,
        half_width=step.place.half_width,
        command=step.command,
        previous=step.before.command,
        params=params.reward,
    )


@dataclasses.dataclass(frozen=True)
class StopAt(Rule):
    """Success is a stop within the tolerance of the goal; any stop ends the episode."""

    has_goal: ClassVar[bool] = True

    def begin(self, noise: ResetNoise, tunnel: Tunnel, params: EnvParams) -> tuple[Array, Array, GoalState]:
        """Near the mouth, facing forward, with a goal ahead."""
        assert params.goal is not None
        goal = GoalState(drawn_goal(noise, tunnel, params.goal), jnp.zeros((), jnp.int32))
        return drawn_start(noise, params), jnp.zeros(()), goal

    def fields(self, params: EnvParams) -> dict[str, Bounds]:
        """Chainage of the goal (m) and distance between rings of the lining (m; 0 where there are none)."""
        del params
        return {"goal": (0.0, np.inf), "ring_pitch": (0.0, np.inf)}

    def observe(self, state: State, tunnel: Tunnel) -> list[Float[Array, ""]]:
        """The same in the order of `fields`."""
        assert state.goal is not None
        return [state.goal.station, tunnel.ring_pitch]

    def judge(self, step: Step, params: EnvParams) -> Verdict:
        """Stopped, and how far from the goal."""
        assert params.goal is not None
        assert step.before.goal is not None
        goal = step.before.goal
        still, stopped = stood(step, params.goal)
        error = step.place.station - goal.station
        success = stopped & (jnp.abs(error) <= params.goal.tolerance)
        nearer = jnp.abs(step.before.station - goal.station) - jnp.abs(error)
        terms = pay(step, params, success=success, stopped=stopped, failed=step.contact, error=error, nearer=nearer)
        after = dataclasses.replace(goal, still=still)
        return Verdict(success, stopped, terms, after, {"goal_error": error, "stopped": stopped})
