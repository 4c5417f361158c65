"""Drive an agent through fixed episodes, all of them at once, and record the result of each."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from subterra_jax.baselines.agent import Agent
from subterra_jax.episode import Driver, Episode, Taken
from subterra_jax.evaluation.episodes import Episodes, EvaluationError
from subterra_jax.evaluation.records import Records, Tally, add_step, make_records, start_tally
from subterra_jax.policies import DrivingPolicy, check_task
from subterra_jax.policies.trained import Trained
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel_env import TunnelEnv

_CHUNK = 200  # steps between two looks at whether any episode is still under way


def evaluate(
    env: TunnelEnv, params: EnvParams, agent: Agent | DrivingPolicy, episodes: Episodes, batch: int = 500
) -> Records:
    """Drive episodes to their ends.

    An episode depends on its seed, its tunnel and its severity alone, neither on the others nor on `batch`. Where
    coverage is the task, the agent drives on after success to the far mouth, which `progress` alone counts.

    Args:
        env: The environment; it need not have been made with `estimates`.
        agent: The agent that drives, or a policy from `load_policy`, whose params must be these.
        episodes: Episodes, from `listed_episodes`.
        batch: Episodes driven at the same time; memory and speed alone depend on it.

    Returns:
        One record for each episode, in their order.

    Raises:
        EvaluationError: `batch` is not positive.
        PolicyError: It is the policy of another task.
    """
    if batch < 1:
        raise EvaluationError(f"batch must be at least 1, got {batch}")
    env, agent, driver = _prepare(env, params, agent)
    tallies = []
    for first in range(0, len(episodes), batch):
        # The last batch is filled up with its last episode, or it would be compiled anew.
        rows = np.minimum(np.arange(first, first + min(batch, len(episodes))), len(episodes) - 1)
        some = Episodes(**{name: values[rows] for name, values in vars(episodes).items()})
        now = driver.begin(params, agent, some.seed, some.tunnel, some.severity)
        for last, _ in driver.drive(params, agent, now, _CHUNK):
            now = last
        tallies.append(jax.device_get(now.tally))
    tally = jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(episodes)], *tallies)
    return make_records(tally, episodes, env, jax.device_get(params))


def fitting_batch(env: TunnelEnv, params: EnvParams, agent: Agent | DrivingPolicy, most: int, gigabytes: float) -> int:
    """Return how many episodes `evaluate` can drive at the same time within some memory: at least 1, at most `most`.

    Args:
        env: The environment, as for `evaluate`.
        most: Number of episodes to drive.
        gigabytes: Memory that driving may take beside params and agent, GB. One episode may take more.
    """
    _, agent, driver = _prepare(env, params, agent)
    batch, limit = most, 1e9 * gigabytes
    while batch > 1 and (needed := driver.bytes_needed(params, agent, batch, _CHUNK)) > limit:
        batch = max(1, min(int(batch * limit / needed), batch - 1))
    return batch


def _prepare(env: TunnelEnv, params: EnvParams, agent: Agent | DrivingPolicy) -> tuple[TunnelEnv, Agent, Driver]:
    agent = agent.agent if isinstance(agent, DrivingPolicy) else agent
    if isinstance(agent, Trained):
        check_task(agent, env, params, agent.name)
    env = dataclasses.replace(env, estimates=True)
    return env, agent, Driver(env, start=_Start(env), add=_Add(env))


# Two of one environment are equal, as two bound methods would not be, so that evaluations share a compiled program.
@dataclasses.dataclass(frozen=True)
class _Start:
    env: TunnelEnv

    def __call__(self, state: State, here: EnvParams) -> Tally:
        return start_tally(self.env, state, here)


@dataclasses.dataclass(frozen=True)
class _Add:
    env: TunnelEnv

    def __call__(self, now: Episode, taken: Taken, here: EnvParams) -> tuple[Tally, Array]:
        """Count a step; a success by coverage stops the count, and the robot drives on to the far mouth."""
        ended = taken.terminated | taken.truncated
        counted = add_step(now.tally, taken, self.env.rule.tolerance(here))
        tally = jax.tree.map(lambda old, new: jnp.where(now.tally.over, old, new), now.tally, counted)
        tally = dataclasses.replace(tally, progress=taken.info["coverage"], over=now.tally.over | ended)
        if self.env.rule.covers:
            at_mouth = taken.info["coverage"] >= 1.0
            ended = taken.info["contact"] | at_mouth | (taken.after.steps >= here.horizon)
        return tally, ended
