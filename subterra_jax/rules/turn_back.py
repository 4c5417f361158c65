"""T2: drive to the goal, turn round, and stop where the episode was asked to begin."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.parts.part import Bounds, Step
from subterra_jax.rules.rule import Start, Verdict
from subterra_jax.rules.stop import StopAt, StopState, count_still, goal_terms
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel


@struct.dataclass
class ReturnState(StopState):
    """Goal of one episode, and whether the robot is on its way back, which ends at the start as reported."""

    flag: Float[Array, ""]  # 1 once the goal has been reached, else 0


@dataclasses.dataclass(frozen=True)
class TurnBack(StopAt):
    """Success is a stop at the station reported as the start, after the flag at the goal was raised."""

    key: ClassVar[str] = "return"
    goal_kind: ClassVar[str] = "return"

    def start(self, draw: tuple[Array, Array, Array], tunnel: Tunnel, params: EnvParams) -> Start:
        start = super().start(draw, tunnel, params)
        own = start.own
        goal = ReturnState(**vars(own), flag=jnp.zeros_like(own.reported))
        return dataclasses.replace(start, own=goal)

    def space(self, params: EnvParams) -> dict[str, Bounds]:
        """Add the flag, before the believed start: 1 once the goal has been reached."""
        entries = super().space(params)
        start = entries.pop("start")
        return {**entries, "flag": (0.0, 1.0), "start": start}

    def observe(self, state: State, tunnel: Tunnel) -> dict[str, Array]:
        entries = super().observe(state, tunnel)
        start = entries.pop("start")
        return {**entries, "flag": state.goal.flag, "start": start}

    def judge(self, step: Step, params: EnvParams) -> Verdict:
        goal = step.before.goal
        still, stopped = count_still(step, params.goal)
        station, back = step.place.station, jnp.abs(step.place.station - goal.reported)
        reached = jnp.abs(station - goal.station) <= params.goal.flag_reach
        flag = jnp.where(reached, 1.0, goal.flag)
        success = stopped & (flag > 0.5) & (back <= params.goal.tolerance)
        to_go = _to_go(station, goal.station, goal.reported, flag)
        nearer = _to_go(step.before.station, goal.station, goal.reported, goal.flag) - to_go
        terms = goal_terms(
            step, params, success=success, stopped=stopped, failed=step.contact, error=to_go, nearer=nearer
        )
        after = dataclasses.replace(goal, still=still, flag=flag)
        info = {"goal_error": station - goal.reported, "stopped": stopped, "flag": flag > 0.5}
        return Verdict(success, stopped, terms, after, info)

    def shortest_way(self, state: State, tunnel: Tunnel, params: EnvParams) -> Float[Array, ""]:
        return 2.0 * super().shortest_way(state, tunnel, params)


def _to_go(
    station: Float[Array, ""], goal: Float[Array, ""], start: Float[Array, ""], flag: Float[Array, ""]
) -> Float[Array, ""]:
    """Way to go: to the goal and back, or only back, m."""
    return jnp.where(flag > 0.5, jnp.abs(station - start), jnp.abs(station - goal) + jnp.abs(goal - start))
