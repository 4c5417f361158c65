"""The environment contract, over every task."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.lidar import LidarParams
from subterra_jax.odometry import OdometryParams
from subterra_jax.state import StartParams
from subterra_jax.vehicle import VehicleParams

INFO = {
    "reward_terminal",
    "reward_coverage",
    "reward_lateral",
    "reward_jerk",
    "coverage",
    "station",
    "lateral",
    "contact",
    "success",
}
FORWARD = jnp.array([2.0, 0.0])


@pytest.fixture(scope="module", params=sorted(st.TASKS))
def task(request):
    env, params = st.make(request.param)
    return env, params, jax.jit(env.reset), jax.jit(env.step)


def leaves_equal(a, b, **tolerance):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(np.asarray(x), np.asarray(y), **tolerance)


def test_reset_and_step_give_what_the_contract_says(task):
    env, params, reset, step = task
    obs, state = reset(jax.random.key(0), params)
    assert (obs.shape, obs.dtype) == ((18,), jnp.float32)
    out = step(jax.random.key(1), state, FORWARD, params)
    obs, state, reward, terminated, truncated, info = out
    assert (obs.shape, reward.shape, terminated.shape, truncated.shape) == ((18,), (), (), ())
    assert (reward.dtype, terminated.dtype, truncated.dtype) == (jnp.float32, jnp.bool_, jnp.bool_)
    assert set(info) == INFO
    space = env.observation_space(params)
    assert space.shape == (env.observation_size(params),) == (18,)
    assert ((obs >= space.low) & (obs <= space.high)).all()
    np.testing.assert_array_equal(env.action_space(params).high, np.float32([2.0, 1.5]))
    np.testing.assert_array_equal(env.action_space(params).low, np.float32([0.0, -1.5]))


def test_a_step_keeps_the_tree_and_the_dtypes_of_the_state(task):
    env, params, _, _ = task
    _, state = jax.eval_shape(env.reset, jax.random.key(0), params)
    _, after, *_ = jax.eval_shape(env.step, jax.random.key(0), state, FORWARD, params)
    assert jax.tree.structure(state) == jax.tree.structure(after)
    described = [jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), tree) for tree in (state, after)]
    assert described[0] == described[1]


def test_every_leaf_of_the_params_is_a_strong_array_of_32_bits(task):
    for leaf in jax.tree.leaves(task[1]):
        assert isinstance(leaf, jax.Array)
        assert leaf.dtype in (jnp.float32, jnp.int32)
        assert not leaf.weak_type


def test_a_step_compiles_once_whatever_the_values(task):
    env, params, reset, _ = task
    step = jax.jit(env.step)
    _, state = reset(jax.random.key(0), params)
    for k in range(3):
        _, state, *_ = step(jax.random.key(k), state, jnp.array([float(k), -0.1 * k]), params)
    step(jax.random.key(9), state, FORWARD, dataclasses.replace(params, horizon=jnp.int32(7)))
    assert step._cache_size() == 1


def test_the_same_key_gives_the_same_result_and_another_key_another(task):
    _, params, reset, step = task
    _, state = reset(jax.random.key(0), params)
    leaves_equal(step(jax.random.key(3), state, FORWARD, params), step(jax.random.key(3), state, FORWARD, params))
    a, b = (step(jax.random.key(k), state, FORWARD, params)[0] for k in (3, 4))
    assert (a != b).any()


def test_two_resets_differ_in_pose_and_in_odometry_bias(task):
    _, params, reset, _ = task
    states = [reset(jax.random.key(k), params)[1] for k in range(2)]
    for name in ("lateral", "heading"):
        assert getattr(states[0], name) != getattr(states[1], name)
    assert states[0].odometry.distance_bias != states[1].odometry.distance_bias
    assert states[0].odometry.heading_bias != states[1].odometry.heading_bias


def test_episodes_start_at_the_mouth_within_their_bounds(task):
    env, params, _, _ = task
    reset = jax.jit(jax.vmap(env.reset, (0, None)))
    _, state = reset(jax.random.split(jax.random.key(0), 500), params)
    assert (np.asarray(state.station) == 0.0).all()
    assert 0.45 < np.abs(state.lateral).max() <= 0.5
    tangent = np.asarray(params.tunnel.grid)[0, 2:4]
    off_axis = np.asarray(state.heading) - np.arctan2(tangent[1], tangent[0])
    assert 0.09 < np.abs(off_axis).max() <= 0.1 + 1e-6


def test_vmap_equals_a_loop(task):
    env, params, reset, step = task
    keys, next_keys = jax.random.split(jax.random.key(0), 6), jax.random.split(jax.random.key(1), 6)
    obs, states = jax.jit(jax.vmap(env.reset, (0, None)))(keys, params)
    actions = jnp.linspace(0.0, 2.0, 6)[:, None] * jnp.array([1.0, 0.3])
    batched = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))(next_keys, states, actions, params)
    for i in range(6):
        first, state = reset(keys[i], params)
        np.testing.assert_allclose(first, obs[i], atol=2e-4)
        alone = step(next_keys[i], state, actions[i], params)
        leaves_equal(alone, jax.tree.map(lambda leaf, i=i: leaf[i], batched), atol=2e-4)


@pytest.mark.parametrize(
    "leaf", ["horizon", "goal_coverage", "lidar.range_sigma", "vehicle.speed_max", "start.lateral"]
)
def test_params_may_be_batched(leaf):
    env, params = st.make("Subterra/TraverseShort-v0")
    axes = jax.tree.map(lambda _: None, params)
    part, _, name = leaf.rpartition(".")
    owner = getattr(params, part) if part else params
    values = jnp.stack([getattr(owner, name), 2 * getattr(owner, name)])

    def put(tree, value):
        inner = dataclasses.replace(getattr(tree, part) if part else tree, **{name: value})
        return dataclasses.replace(tree, **{part: inner}) if part else inner

    @jax.jit
    def two_steps(params):
        _, state = jax.jit(env.reset)(jax.random.key(0), params)
        _, state, *_ = env.step(jax.random.key(1), state, FORWARD, params)
        return env.step(jax.random.key(2), state, FORWARD, params)

    batched = jax.jit(jax.vmap(two_steps, (put(axes, 0),)))(put(params, values))
    for i, value in enumerate(values):
        alone = two_steps(put(params, value))
        leaves_equal(alone, jax.tree.map(lambda x, i=i: x[i], batched), atol=2e-4)


def test_an_episode_is_truncated_at_the_horizon_and_that_is_not_termination():
    env, params = st.make("Subterra/TraverseShort-v0", horizon=5)
    _, state = jax.jit(env.reset)(jax.random.key(0), params)
    step = jax.jit(env.step)
    for k in range(5):
        _, state, _, terminated, truncated, info = step(jax.random.key(k), state, jnp.array([0.5, 0.0]), params)
        assert not terminated
        assert bool(truncated) == (k == 4)
    assert not info["success"]


def test_ninety_percent_coverage_is_success_and_ends_the_episode_once():
    env, params = st.make("Subterra/TraverseShort-v0", start=StartParams(station=53.0, lateral=0.0, heading=0.0))
    _, state = jax.jit(env.reset)(jax.random.key(0), params)
    step, ends = jax.jit(env.step), []
    for k in range(8):
        _, state, _, terminated, truncated, info = step(jax.random.key(k), state, FORWARD, params)
        ends.append((bool(terminated), bool(info["success"]), float(info["reward_terminal"])))
        assert not truncated
        if terminated:
            break
    assert ends == [(False, False, 0.0)] * 4 + [(True, True, 1.0)] or ends[-1] == (True, True, 1.0)
    assert float(info["coverage"]) >= 0.9


def test_touching_a_wall_terminates_without_success():
    env, params = st.make("Subterra/TraverseShort-v0")
    _, state = jax.jit(env.reset)(jax.random.key(0), params)
    step = jax.jit(env.step)
    for k in range(100):
        _, state, reward, terminated, truncated, info = step(jax.random.key(k), state, jnp.array([2.0, 0.3]), params)
        if terminated:
            break
    assert info["contact"]
    assert not info["success"]
    assert not truncated
    assert np.isfinite(float(reward))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_actions_that_are_not_numbers_leave_everything_finite(task, bad):
    _, params, reset, step = task
    _, state = reset(jax.random.key(0), params)
    for k in range(3):
        obs, state, reward, *_ = step(jax.random.key(k), state, jnp.full(2, bad), params)
        assert np.isfinite(np.asarray(obs)).all()
        assert np.isfinite(float(reward))
        assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(state))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"id": "Subterra/Nowhere-v0"}, "no task 'Subterra/Nowhere-v0'"),
        ({"speed": 3.0}, "no field"),
        ({"lidar": LidarParams(n_beams=0)}, "n_beams must be at least 1, got 0"),
        ({"vehicle": VehicleParams(radius=1.5)}, "radius must be in"),
        ({"vehicle": VehicleParams(speed_max=5.0)}, "must leave 0.2 m"),
        ({"lining": "velvet"}, "no lining 'velvet'"),
    ],
)
def test_a_mistake_is_refused_with_its_value(arguments, message):
    with pytest.raises((ValueError, st.TunnelError), match=message):
        st.make(**{"id": "Subterra/TraverseShort-v0", **arguments})


def test_a_ready_tunnel_is_taken_as_it_is_but_not_beyond_its_reach():
    plan = st.load_tunnel().slice(100.0, 80.0)
    tunnel = st.Tunnel.from_plan(plan, "smooth")
    _, params = st.make("Subterra/TraverseShort-v0", tunnel=tunnel)
    assert float(params.tunnel.length) == pytest.approx(80.0)
    with pytest.raises(ValueError, match="ranges up to 30"):
        st.make("Subterra/TraverseShort-v0", tunnel=tunnel, lidar=LidarParams(range_max=50.0))


def test_the_short_task_is_the_first_60_metres():
    assert float(st.make("Subterra/TraverseShort-v0")[1].tunnel.length) == pytest.approx(60.0)
    assert float(st.make("Subterra/TraverseShort-v0", odometry=OdometryParams())[1].horizon) == 600
    assert float(st.make("Subterra/Traverse-v0")[1].horizon) == 3000
