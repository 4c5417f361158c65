"""What agents say and remember on ways of which they do not choose the commands is what it was."""

from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines.agent import observed
from subterra_jax.parts.obstacles import ObstacleParams
from subterra_jax.rules import GoalParams
from tests.recorded import check

TABLE = Path(__file__).with_name("thoughts.csv")
NEAR = {"goal": GoalParams(low=20.0, high=30.0, margin=10.0)}
WAYS = {  # length of the tunnel (m), task, and what is not its own
    "Return": (351.0, "Return", {}),
    "Stop": (80.0, "StopAtShort", NEAR),
    "Hidden": (80.0, "StopAt", {**NEAR, "hidden_start": True}),
    "Report": (200.0, "Relocalise", {}),
    "Faults": (80.0, "Faulted", {**NEAR, "obstacles": ObstacleParams()}),
}
AGENTS = (
    *(("Return", name) for name in ("fused", "scan-matching", "Return-locate")),
    *(("Stop", name) for name in ("histogram-filter", "locate-map", "locate-transformer")),
    *(("Hidden", name) for name in ("ceiling", "particle-filter")),
    *(("Report", name) for name in ("histogram-filter", "particle-filter")),
    *(("Faults", name) for name in ("ceiling", "oracle", "random", "locate-obstructed")),
)


@cache
def way(name, n_steps):
    """An environment, its params, and observations and truths of a way through a piece of the packaged tunnel."""
    length, task, options = WAYS[name]
    env, params = st.make(f"Subterra/{task}-v1", tunnel=st.load_tunnel().slice(0.0, length), **options)
    step = jax.jit(env.step)
    obs, state = jax.jit(env.reset)(jax.random.key(3), params)
    seen = []
    for k in range(n_steps):
        seen.append((obs, env.privileged(state, params)))
        action = jnp.zeros(env.action_size).at[:2].set(jnp.array([2.0 - 0.05 * (k % 12), 0.1 * (-1) ** (k // 2)]))
        obs, state, *_ = step(jax.random.key(k), state, action, params)
    return env, params, jax.tree.map(lambda *rows: jnp.stack(rows), *seen)


@pytest.mark.parametrize(("task", "name"), AGENTS)
def test_an_agent_thinks_what_it_thought(task, name):
    env, params, (flat, truth) = way(task, 75 if "locate" in name else 12)
    agent = st.load_policy(name, env, params).agent

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
    leaves = jax.tree_util.tree_flatten_with_path(memory)[0]
    held = {jax.tree_util.keystr(path, simple=True, separator=" "): np.asarray(leaf, float) for path, leaf in leaves}
    check(TABLE, f"{task} {name}", {"said": said, "memory": held}, 3e-4)
