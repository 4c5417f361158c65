"""T5: placed anywhere with a map, find the station and the direction faced, stop and report them."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.parts.part import Bounds, Step
from subterra_jax.rules.rule import Choice, Rule, Start, Verdict, spread
from subterra_jax.rules.stop import GoalRule, GoalState, count_still, goal_terms
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel


@struct.dataclass
class RelocaliseState(GoalState):
    """Start of one episode, and the distance driven since."""

    travelled: Float[Array, ""]  # true distance driven, m


@dataclasses.dataclass(frozen=True)
class Relocalise(GoalRule):
    """Success is a right report at the stop: the one in the action of the step that makes it a stop.

    No mouth comes into view within the travel that is allowed.
    """

    key: ClassVar[str] = "relocalise"
    goal_kind: ClassVar[str] = "report"
    reports: ClassVar[bool] = True

    def start(self, draw: tuple[Array, Array, Array], tunnel: Tunnel, params: EnvParams) -> Start:
        """Start anywhere but within `goal.margin` of a mouth, facing either way."""
        room = jnp.maximum(tunnel.length - 2.0 * params.goal.margin, 0.0)
        station = params.goal.margin + room * draw[1][1]
        backwards = (draw[1][2] < 0.5).astype(station.dtype)
        goal = RelocaliseState(station, jnp.zeros((), jnp.int32), jnp.zeros_like(station))
        return Start(station, **spread(draw[0], params), backwards=backwards, own=goal)

    def place(self, start: Start, choice: Choice) -> Start:
        """Return a start with a chosen place; there is no goal."""
        start = Rule.place(self, start, choice)
        return dataclasses.replace(start, own=dataclasses.replace(start.own, station=start.station))

    def space(self, params: EnvParams) -> dict[str, Bounds]:
        """Distance between rings of the lining, m; 0 where there are none."""
        return {"ring_pitch": (0.0, np.inf)}

    def observe(self, state: State, tunnel: Tunnel) -> dict[str, Array]:
        return {"ring_pitch": tunnel.ring_pitch}

    def judge(self, step: Step, params: EnvParams) -> Verdict:
        goal = step.before.goal
        still, stopped = count_still(step, params.goal)
        along = step.place.tangent
        forward = jnp.cos(step.heading) * along[0] + jnp.sin(step.heading) * along[1] > 0.0
        error = step.report[0] - step.place.station
        direction_right = (step.report[2] > 0.0) == forward
        success = stopped & direction_right & (jnp.abs(error) <= params.goal.tolerance)
        travelled = goal.travelled + step.moved
        overdue = (travelled > params.goal.travel_max) & ~stopped
        terms = goal_terms(
            step,
            params,
            success=success,
            stopped=stopped & direction_right,
            failed=step.contact | overdue,
            error=error,
            nearer=jnp.zeros_like(error),
        )
        after = dataclasses.replace(goal, still=still, travelled=travelled)
        info = {"goal_error": error, "stopped": stopped, "direction_right": direction_right}
        return Verdict(success, stopped | overdue, terms, after, info)

    def least_length(self, params: EnvParams) -> float:
        return float(1.0 + 2.0 * np.max(params.goal.margin))
