"""Drive one episode and keep every state of it; a listed seed gives the very episode that the leaderboard scores."""

import dataclasses
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Agent
from subterra_jax.env import TunnelEnv
from subterra_jax.episode import Driver, Episode, Taken, concatenate
from subterra_jax.state import EnvParams, State

_CHUNK = 200  # steps between two looks at whether the episode is over


@dataclasses.dataclass(frozen=True)
class Trace:
    """An episode of `n` steps, on the host; row k is the moment after k periods, from 0 to n.

    Attributes:
        state: States, each leaf with a leading axis of `n + 1`.
        observation: Observations as the agent got them, `(n + 1, n_obs)`.
        command: Speed (m/s) and yaw rate (rad/s) obeyed from row k to row k + 1, `(n, 2)`.
        period: Control period, s.
        success: The task was achieved.
        contact: The episode ended at a wall or an obstacle.
    """

    state: State
    observation: Float[np.ndarray, "rows n_obs"]
    command: Float[np.ndarray, "n 2"]
    period: float
    success: bool
    contact: bool

    @property
    def time(self) -> Float[np.ndarray, " rows"]:
        """Time of each row since the start, s."""
        return np.arange(len(self.observation)) * self.period


def drive(
    env: TunnelEnv, params: EnvParams, agent: Agent, seed: int, severity: int | None = None, steps: int | None = None
) -> Trace:
    """Drive to the end of the episode, or for a number of steps.

    Args:
        env: The environment.
        params: The task in one tunnel.
        agent: The agent that drives.
        seed: Seed of everything random.
        severity: Severity of the faults; drawn where it is left out.
        steps: Steps at most; the task's horizon if left out.
    """
    driver = Driver(dataclasses.replace(env, estimates=True), keep=_row)
    begun = driver.begin(params, agent, seed, level=severity)
    rows = concatenate([jax.device_get(kept) for _, kept in driver.drive(params, agent, begun, _CHUNK, steps)])
    limit = int(params.horizon) if steps is None else min(steps, int(params.horizon))
    n = min(limit, int(np.argmax(rows["over"])) + 1 if rows["over"].any() else limit)
    last = jax.device_get(_last(driver.env, params, jax.tree.map(lambda leaf: leaf[n - 1], rows["after"])))
    return Trace(
        state=jax.tree.map(lambda before, end: np.concatenate([before[:n], end[None]]), rows["before"], last[0]),
        observation=np.concatenate([rows["observation"][:n], last[1][None]]),
        command=rows["after"][0].command[:n],
        period=round(float(params.vehicle.period), 6),  # 0.1 in float32 is not 0.1
        success=bool(rows["success"][n - 1]),
        contact=bool(rows["contact"][n - 1]),
    )


def _row(now: Episode, taken: Taken, params: EnvParams) -> dict[str, Any]:
    """Keep one step."""
    del now, params
    return {
        "before": taken.before,
        "after": (taken.after, taken.noise),
        "observation": taken.observation,
        "over": taken.terminated | taken.truncated,
        "success": taken.info["success"],
        "contact": taken.info["contact"],
    }


@partial(jax.jit, static_argnums=0)
def _last(env: TunnelEnv, params: EnvParams, after: tuple[State, Any]) -> tuple[State, Float[Array, "n_obs"]]:
    """Return the last state and its observation."""
    state, noise = after
    return state, env.observe(state, noise, params)
