"""T5: put down anywhere with a map, find out where one is and which way one faces, stop and say so."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.rules.rule import Bounds, Rule, Step, Verdict
from subterra_jax.rules.stop import pay, stood
from subterra_jax.state import EnvParams, GoalState, ResetNoise, State
from subterra_jax.tunnel import Tunnel


@dataclasses.dataclass(frozen=True)
class Relocalise(Rule):
    """Success is a right report at the stop; the report is the one in the action of the step that makes it a stop."""

    has_goal: ClassVar[bool] = True
    reports: ClassVar[bool] = True

    def begin(self, noise: ResetNoise, tunnel: Tunnel, params: EnvParams) -> tuple[Array, Array, GoalState]:
        """Anywhere but at the ends, facing either way."""
        assert params.goal is not None
        assert noise.goal is not None
        room = jnp.maximum(tunnel.length - 2.0 * params.goal.margin, 0.0)
        start = params.goal.margin + room * noise.goal[1]
        backwards = (noise.goal[2] < 0.5).astype(jnp.float32)
        return start, backwards, GoalState(start, jnp.zeros((), jnp.int32), travelled=jnp.zeros(()))

    def fields(self, params: EnvParams) -> dict[str, Bounds]:
        """Distance between rings of the lining, m; 0 where there are none."""
        del params
        return {"ring_pitch": (0.0, np.inf)}

    def observe(self, state: State, tunnel: Tunnel) -> list[Float[Array, ""]]:
        """The same."""
        del state
        return [tunnel.ring_pitch]

    def judge(self, step: Step, params: EnvParams) -> Verdict:
        """What was reported against where the robot stands."""
        assert params.goal is not None
        assert step.before.goal is not None
        goal = step.before.goal
        assert goal.travelled is not None
        still, stopped = stood(step, params.goal)
        along = step.place.tangent
        forward = jnp.cos(step.heading) * along[0] + jnp.sin(step.heading) * along[1] > 0.0
        error = step.report[0] - step.place.station
        direction_right = (step.report[2] > 0.0) == forward
        success = stopped & direction_right & (jnp.abs(error) <= params.goal.tolerance)
        travelled = goal.travelled + step.moved
        overdue = (travelled > params.goal.travel_max) & ~stopped
        terms = pay(
            step,
            params,
            success=success,
            stopped=stopped & direction_right,
            failed=step.contact | overdue,
            error=error,
            nearer=jnp.zeros(()),
        )
        after = dataclasses.replace(goal, still=still, travelled=travelled)
        told = {"goal_error": error, "stopped": stopped, "direction_right": direction_right}
        return Verdict(success, stopped | overdue, terms, after, told)
