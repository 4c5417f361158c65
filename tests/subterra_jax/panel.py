"""Several agents in one compiled program, and agents whose observation is corrupted: for tests of leaks."""

import dataclasses
from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array

from subterra_jax.baselines.agent import Observed


@struct.dataclass
class Panel:
    """All of several agents think, one of them acts.

    Attributes:
        agents: The agents.
        index: Which of them acts.
        order: In which order it gets the beams.
        goal: Goal that it is given; NaN is it the true one.
    """

    agents: tuple[Any, ...]
    index: Array
    order: Array
    goal: Array
    name: str = struct.field(pytree_node=False, default="panel")
    uses_lidar: bool = struct.field(pytree_node=False, default=True)
    uses_map: bool = struct.field(pytree_node=False, default=True)
    privileged: bool = struct.field(pytree_node=False, default=True)

    def begin(self, key, obs, params):
        return tuple(agent.begin(key, self._corrupted(obs, agent), params) for agent in self.agents)

    def act(self, key, memory, obs, params, known):
        pairs = [
            agent.act(key, m, self._corrupted(obs, agent), params, known if agent.privileged else None)
            for agent, m in zip(self.agents, memory, strict=True)
        ]
        return jnp.stack([action for action, _ in pairs])[self.index], tuple(m for _, m in pairs)

    def _corrupted(self, obs: Observed, agent: Any) -> Observed:
        ranges = obs.ranges[self.order] if agent.uses_lidar else jnp.full_like(obs.ranges, jnp.nan)
        goal = None if obs.goal is None else jnp.where(jnp.isnan(self.goal), obs.goal, self.goal)
        return dataclasses.replace(obs, ranges=ranges, goal=goal)


def panel(agents, index=0, order=None, goal=jnp.nan) -> Panel:
    order = jnp.arange(16) if order is None else jnp.asarray(order)
    return Panel(tuple(agents), jnp.int32(index), order, jnp.float32(goal))
