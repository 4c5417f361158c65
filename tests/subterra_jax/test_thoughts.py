"""Actions and memories of agents on ways whose commands others chose: they are what they were."""

from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import subterra_jax as st
from subterra_jax.baselines.agent import observed
from subterra_jax.baselines.registry import make_agent
from subterra_jax.parts.obstacles import ObstacleParams
from subterra_jax.policies import load
from subterra_jax.policies.files import is_policy
from subterra_jax.rules import GoalParams
from tests.recorded import check, named

TABLE = Path(__file__).with_name("thoughts.csv")
NEAR = {"goal": GoalParams(low=18.0, high=19.0, margin=10.0)}
WAYS = {  # length of the tunnel (m), task, and what is not its own
    "Return": (80.0, "Return", NEAR),
    "Stop": (80.0, "StopAtShort", NEAR),
    "Hidden": (80.0, "StopAt", {**NEAR, "hidden_start": True}),
    "Report": (200.0, "Relocalise", {}),
    "Faults": (80.0, "Faulted", {**NEAR, "obstacles": ObstacleParams()}),
}
AGENTS = (
    *(("Return", name, 200) for name in ("fused", "oracle", "scan-matching", "Return-locate", "Return-v1")),
    *(("Stop", name, 12) for name in ("histogram-filter", "StopAt-v1", "fused", "dead-reckoning")),
    *(("Hidden", name, 3) for name in ("ceiling", "particle-filter")),  # then rounding draws other particles
    ("Hidden", "locate-map", 150),
    ("Report", "histogram-filter", 12),
    ("Faults", "ceiling", 3),
    *(("Faults", name, 12) for name in ("oracle", "random", "fused", "locate-obstructed")),
)
TURN = range(120, 141)  # steps of half a turn


@cache
def way(name):
    """An environment, its params, and observations and truths of a way through a piece of the packaged tunnel."""
    length, task, options = WAYS[name]
    env, params = st.make(f"Subterra/{task}-v1", tunnel=st.load_tunnel().slice(0.0, length), **options)
    step = jax.jit(env.step)
    obs, state = jax.jit(env.reset)(jax.random.key(3), params)
    seen = []
    for k in range(max(n for task, _, n in AGENTS if task == name)):
        seen.append((obs, env.privileged(state, params)))
        speed, rate = (0.2, 1.5) if name == "Return" and k in TURN else (2.0 - 0.05 * (k % 12), 0.1 * (-1) ** (k // 2))
        obs, state, *_ = step(
            jax.random.key(k), state, jnp.zeros(env.action_size).at[:2].set(jnp.array([speed, rate])), params
        )
    return env, params, jax.tree.map(lambda *rows: jnp.stack(rows), *seen)


@pytest.mark.parametrize(("task", "name", "n"), AGENTS)
def test_an_agent_thinks_what_it_thought(task, name, n):
    env, params, seen = way(task)
    flat, truth = jax.tree.map(lambda rows: rows[:n], seen)
    agent = load(name)[0].with_map(params) if is_policy(name) else make_agent(name, params)

    @jax.jit
    def think(flat, truth, params):
        def act(memory, row):
            key, flat, known = row
            obs, told = observed(env, params, flat), known if agent.privileged else None
            action, memory = agent.act(key, memory, obs, params, told)
            return memory, action

        keys = jax.random.split(jax.random.key(4), len(flat))
        return jax.lax.scan(act, agent.begin(keys[0], observed(env, params, flat[0]), params), (keys, flat, truth))

    memory, said = think(flat, truth, params)
    check(TABLE, f"{task} {name}", {"said": said, "memory": named(memory)}, 3e-4 if n == 12 else 2e-3)
