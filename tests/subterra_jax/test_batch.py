"""Batches that reset themselves: fresh draws, exact final observations, no influence of the batch's size."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import lidar
from subterra_jax.lidar import LidarParams

TASK = "Subterra/TraverseShort-v1"
N, FEW = 128, 8  # every other size is another program


def batch_of(**overrides):
    env, params = st.make(TASK, **overrides)
    return st.AutoReset(env), params


def actions(seed: int, n: int = N) -> jax.Array:
    return jax.random.uniform(jax.random.key(seed), (n, 2), minval=jnp.array([0.0, -1.5]), maxval=jnp.array([2.0, 1.5]))


# Eager code would compile every operation by itself.
reset_jit = jax.jit(lambda batch, key, params, n: batch.reset(key, params, n), static_argnums=(0, 3))
step_jit = jax.jit(lambda batch, *arguments: batch.step(*arguments), static_argnums=0)


def run(batch, params, n: int, steps: int, action=None):
    obs, state = reset_jit(batch, jax.random.key(0), params, n)
    outs = []
    for k in range(steps):
        chosen = actions(k, N)[:n] if action is None else jnp.broadcast_to(jnp.array(action), (n, 2))
        outs.append((state, step_jit(batch, jax.random.key(100 + k), state, chosen, params)))
        state = outs[-1][1][1]
    return obs, outs


def test_a_batch_steps_like_its_environments_alone():
    batch, params = batch_of(horizon=1000)
    env = batch.env
    _, state = reset_jit(batch, jax.random.key(0), params, FEW)
    action = actions(0, FEW)
    obs, after, reward, terminated, truncated, info = step_jit(batch, jax.random.key(1), state, action, params)
    assert not (terminated | truncated).any()
    noise = env.draw_step(jax.random.split(jax.random.key(1))[0], (FEW,), params)
    advance, observe = jax.jit(env.advance), jax.jit(env.observe)
    for i in range(FEW):
        one, mine = jax.tree.map(lambda x, i=i: x[i], (state, noise))
        new, gain, *_ = advance(one, action[i], mine, params)
        np.testing.assert_allclose(observe(new, mine, params), obs[i], atol=2e-4)
        np.testing.assert_allclose(gain, reward[i], atol=1e-6)
        np.testing.assert_allclose(new.position, after.position[i], atol=1e-5)
    np.testing.assert_array_equal(info["final_observation"], obs)


@pytest.mark.parametrize(("horizon", "n_done"), [(4, "all of them"), (1000, "a few of them")])
def test_the_final_observation_is_that_of_the_state_before_the_reset(horizon, n_done):
    batch, params = batch_of(horizon=horizon, lidar=LidarParams(range_sigma=0.0))
    scan = jax.jit(jax.vmap(partial(lidar.scan, params=params.lidar), (None, 0, 0, 0)))
    counts = []
    _, outs = run(batch, params, N, 45)
    advance = jax.jit(jax.vmap(batch.env.advance, (0, 0, 0, None)))
    for k, (before, out) in enumerate(outs):
        obs, after, _, terminated, truncated, info = out
        done = np.asarray(terminated | truncated)
        counts.append(done.sum())
        noise = batch.env.draw_step(jax.random.split(jax.random.key(100 + k))[0], (N,), params)
        stepped, *_ = advance(before, actions(k), noise, params)
        final = np.asarray(info["final_observation"])
        truth = np.asarray(scan(params.tunnel, stepped.position, stepped.heading, stepped.station))
        np.testing.assert_allclose(final[:, :16], truth, atol=2e-3)
        np.testing.assert_allclose(final[:, 16], stepped.odometry.distance, atol=1e-5)
        np.testing.assert_array_equal(final[~done], np.asarray(obs)[~done])
        # Where an episode ended the observation is the first of the next one.
        assert (np.asarray(obs)[done, 16:] == 0.0).all()
        assert (np.asarray(after.steps)[done] == 0).all()
        assert (np.asarray(after.station)[done] == 0.0).all()
    few = max(1, N // 32)
    assert max(counts) == N if n_done == "all of them" else any(0 < count <= few for count in counts)


def test_each_episode_of_one_environment_has_its_own_bias_and_start():
    batch, params = batch_of(horizon=3)
    _, outs = run(batch, params, FEW, 12, action=(1.0, 0.0))
    states = [after for _, (_, after, *_) in outs][2::3]
    for name in ("distance_bias", "heading_bias"):
        values = np.stack([np.asarray(getattr(state.odometry, name)) for state in states])
        assert len(np.unique(values)) == values.size
    starts = np.stack([np.asarray(state.lateral) for state in states])
    assert len(np.unique(starts)) == starts.size


def test_params_of_every_environment_may_be_stacked_whole():
    shared, params = batch_of(horizon=2)
    stacked = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (FEW, *leaf.shape)), params)
    batch = st.AutoReset(shared.env, params_axes=0)
    obs, state = reset_jit(batch, jax.random.key(0), stacked, FEW)
    same, _ = reset_jit(shared, jax.random.key(0), params, FEW)
    np.testing.assert_allclose(obs, same, atol=2e-4)
    for k in range(2):
        obs, state, *_, info = step_jit(batch, jax.random.key(k), state, actions(k, FEW), stacked)
    assert (np.asarray(info["final_observation"])[:, 16] != 0.0).all()


def test_a_rollout_in_one_scan_equals_the_steps_one_by_one():
    batch, params = batch_of(horizon=4)

    def policy(key, obs):
        return jnp.stack([1.0 + 0.0 * obs[:, 0], jax.random.uniform(key, obs.shape[:1], minval=-0.3, maxval=0.3)], -1)

    obs, state = reset_jit(batch, jax.random.key(0), params, FEW)
    last, _, record = jax.jit(lambda o, s: st.rollout(batch, policy, jax.random.key(5), o, s, params, 9))(obs, state)
    for k, key in enumerate(jax.random.split(jax.random.key(5), 9)):
        policy_key, env_key = jax.random.split(key)
        np.testing.assert_allclose(record["obs"][k], obs, atol=2e-4)
        obs, state, reward, *_ = step_jit(batch, env_key, state, policy(policy_key, obs), params)
        np.testing.assert_allclose(record["reward"][k], reward, atol=1e-5)
    np.testing.assert_allclose(last, obs, atol=2e-4)
    assert record["info"]["final_observation"].shape == (9, FEW, 18)
