"""Unrolls with every memory, and what a localiser learns of its drives, are what they were (see `tests.recorded`)."""

from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import subterra_jax as st
from tests.recorded import check, named
from tests.subterra_jax import tunnels
from tests.train.conftest import weights_of
from train.config import TrainConfig
from train.driver import Policy
from train.drives import record_drives
from train.policies import begin_with
from train.rollout import begin, collect
from train.setup import make_learner
from train.world import World

TABLE = Path(__file__).with_name("values.csv")
HORIZON, N_STEPS = 9, 12
MEMORIES = {
    "stack": ("Return", {"frames": 2, "standing": 0.2}),
    "along": ("Return", {"frames": 2, "walls": True, "cruise": 1.2, "begin_from": "locate-transformer"}),
    "map": ("Relocalise", {"map_cell": 1.0}),
}


def learner_of(task, config, tunnel, horizon=None):
    env, params = st.make(f"Subterra/{task}-v1", tunnel=tunnel, **({} if horizon is None else {"horizon": horizon}))
    return make_learner(World(f"Subterra/{task}-v1", env, params, {}), config), env, params


@pytest.mark.parametrize("memory", MEMORIES)
def test_an_unroll_is_what_it_was(memory):
    """Twelve steps of two robots whose episodes end after nine."""
    task, own = MEMORIES[memory]
    config = TrainConfig(memory=memory, hidden=(8,), n_envs=4, unroll=8, minibatches=2, **own)
    learner, env, params = learner_of(task, config, st.load_tunnel(), HORIZON)
    driver = learner.driver
    policy = Policy(weights_of(driver, 0, 0.05), learner.given.localiser)

    @jax.jit
    def unroll(policy, params):
        drive = begin(env, driver, policy, params, jax.random.PRNGKey(1), 2)
        return drive.kept, collect(env, driver, policy, params, drive, jax.random.PRNGKey(2), N_STEPS)

    check(TABLE, f"unroll {memory}", named(unroll(policy, params)), 1e-3)


def test_drives_are_drawn_as_they_were(tmp_path):
    """Places, speeds and the first steps of 64 robots, some of which start where the task does."""
    plan = tunnels.write_tunnel(tmp_path / "straight.npz", tunnels.tunnel_arrays(tunnels.straight(120.0)))
    learner, _, params = learner_of("StopAtShort", TrainConfig(memory="along", auxiliary=True, hidden=(8,)), plan)
    policy = Policy(weights_of(learner.driver, 0))
    run = jax.jit(lambda policy, params: record_drives(learner.driver, policy, params, jax.random.PRNGKey(3), 64, 4))
    check(TABLE, "drives", named(run(policy, params)), 1e-3)


def test_a_localiser_learns_what_it_learnt(tmp_path):
    """Drives of more than 100 m at speeds of their own past pockets, beside a map that may be of elsewhere."""
    config = TrainConfig(
        memory="along", auxiliary=True, map=True, hidden=(8,), drives=2, drives_minibatch=2, drive_steps=540,
        init_std=0.05, init_turn=0.001, n_envs=4, unroll=8, minibatches=2,
    )  # fmt: skip
    plan = tunnels.write_tunnel(tmp_path / "straight.npz", tunnels.tunnel_arrays(tunnels.straight(260.0)))
    learner, _, params = learner_of("StopAtShort", config, plan)
    weights = weights_of(learner.driver, 0)
    weights["actor"]["out"]["bias"] = jnp.array([2.0, 0.0])  # straight on at nearly full speed
    init, learn = jax.jit(learner._localiser.init), jax.jit(learner._localiser.learn)
    check(TABLE, "fresh", named(init(jax.random.PRNGKey(1))))
    before = init(jax.random.PRNGKey(1), begin_with("locate-map").localiser)
    after = learn(before, Policy(weights, before.weights), params, jax.random.PRNGKey(2), jnp.int32(1))
    check(TABLE, "localiser", named(after), 2e-3)
