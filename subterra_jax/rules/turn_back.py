"""T2: drive to the goal, turn round, and stop where one began."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from subterra_jax.rules.rule import Bounds, Step, Verdict
from subterra_jax.rules.stop import StopAt, pay, stood
from subterra_jax.state import EnvParams, GoalState, ResetNoise, State
from subterra_jax.tunnel import Tunnel


@dataclasses.dataclass(frozen=True)
class TurnBack(StopAt):
    """Success is a stop within the tolerance of the start after the flag at the goal was raised."""

    def begin(self, noise: ResetNoise, tunnel: Tunnel, params: EnvParams) -> tuple[Array, Array, GoalState]:
        """As for `StopAt`, the flag down."""
        start, backwards, goal = super().begin(noise, tunnel, params)
        return start, backwards, dataclasses.replace(goal, start=start, flag=jnp.zeros(()))

    def fields(self, params: EnvParams) -> dict[str, Bounds]:
        """As for `StopAt`, and the flag: 1 once the goal has been reached."""
        return {**super().fields(params), "flag": (0.0, 1.0)}

    def observe(self, state: State, tunnel: Tunnel) -> list[Float[Array, ""]]:
        """The same in the order of `fields`."""
        assert state.goal is not None
        assert state.goal.flag is not None
        return [*super().observe(state, tunnel), state.goal.flag]

    def judge(self, step: Step, params: EnvParams) -> Verdict:
        """The flag, then the stop."""
        assert params.goal is not None
        assert step.before.goal is not None
        goal = step.before.goal
        assert goal.start is not None
        assert goal.flag is not None
        still, stopped = stood(step, params.goal)
        station, back = step.place.station, jnp.abs(step.place.station - goal.start)
        reached = jnp.abs(station - goal.station) <= params.goal.flag_reach
        flag = jnp.where(reached, 1.0, goal.flag)
        success = stopped & (flag > 0.5) & (back <= params.goal.tolerance)
        to_go = _to_go(station, goal.station, goal.start, flag)
        nearer = _to_go(step.before.station, goal.station, goal.start, goal.flag) - to_go
        terms = pay(step, params, success=success, stopped=stopped, failed=step.contact, error=to_go, nearer=nearer)
        after = dataclasses.replace(goal, still=still, flag=flag)
        told = {"goal_error": station - goal.start, "stopped": stopped, "flag": flag > 0.5}
        return Verdict(success, stopped, terms, after, told)


def _to_go(
    station: Float[Array, ""], goal: Float[Array, ""], start: Float[Array, ""], flag: Float[Array, ""]
) -> Float[Array, ""]:
    """Way to go: to the goal and back, or only back, m."""
    return jnp.where(flag > 0.5, jnp.abs(station - start), jnp.abs(station - goal) + jnp.abs(goal - start))
