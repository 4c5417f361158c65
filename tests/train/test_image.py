"""A policy that sees the image of a LiDAR in three dimensions: its lesson fits together, its release drives alike."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import policies as released
from subterra_jax.baselines import registry
from subterra_jax.baselines.agent import observed
from subterra_jax.policies import senses
from subterra_jax.policies.loading import check_task
from train.policies import policy_tensors
from train.recurrent import drive as driving
from train.recurrent.config import make_distill_config
from train.recurrent.distill import DistillLearner
from train.recurrent.network import without_critic

TASK = "Subterra/StopAtShort-v1"


@pytest.mark.slow
def test_a_student_with_an_image_learns_and_its_release_gives_the_same_action():
    xy = np.stack([np.linspace(0.0, 70.0, 71), np.zeros(71)], axis=-1)
    plan = st.tunnel.from_centreline(xy, 2.8, ring_pitch=1.5)
    env, params = st.make(TASK, tunnel=plan, sensor="spin16x64")
    config = dataclasses.replace(make_distill_config(TASK, "cpu"), n_envs=32)
    learner = DistillLearner(env, params, config, registry.make_agent("oracle", params))
    assert learner.networks.layout.image == (16, 64)
    before = jax.eval_shape(learner.init, jax.random.key(0), params)
    after, _ = jax.eval_shape(learner.iterate, before, params)
    assert jax.tree.structure(before) == jax.tree.structure(after)

    weights = learner.networks.init(jax.random.key(0))
    layout = dataclasses.asdict(learner.networks.layout)
    agent = released.from_tensors("gru", layout, policy_tensors(learner.networks, without_critic(weights)), "student")
    check_task(agent, env, params, "student")
    seen = 5.0 * jax.random.uniform(jax.random.key(1), (2, env.observation_size(params)))
    # The second differs in its image alone, outside the ring that stands for a planar scan.
    seen = seen.at[1].set(seen[0]).at[1, :256].set(9.0)
    actions = []
    for flat in seen:
        view, inputs = driving.look(env, params, flat[None], senses.start((1,), 16, learner.networks.layout.shown))
        hidden, _ = learner.networks.remember(
            weights, driving.one_moment(inputs), jnp.zeros((1, config.hidden)), jnp.ones((1, 1), bool)
        )
        thought = learner.networks.think(weights, hidden, view.ahead)
        actions.append(np.asarray(learner.networks.action(thought.parameters[0, :2])))
        answer, _ = agent.answer(agent.blank(), observed(env, params, flat), params.start.station)
        np.testing.assert_allclose(answer[:2], actions[-1], atol=1e-5)
    assert np.abs(actions[0] - actions[1]).max() > 1e-5
