"""Stable-Baselines3 trains on the adapter, its conventions hold, and scans in three dimensions are images."""

import copy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

import subterra_jax as st
from subterra_jax.adapters.kernel import as_observation, compile_as_one_kernel, pack, start_streams
from subterra_jax.adapters.sb3 import SubterraVecEnv
from subterra_jax.adapters.single import SubterraEnv
from subterra_jax.adapters.task import Task
from subterra_jax.parts import make_sensor
from subterra_jax.parts.part import Boxes
from subterra_jax.pictures import top_down as drawing
from subterra_jax.pictures.views import make_view

TASK, HORIZON = "Subterra/TraverseShort-v1", 24
ACTIONS = np.array([[1.0, 0.0], [2.0, 1.5]], np.float32)


@pytest.fixture(scope="module")
def envs():
    return SubterraVecEnv(2, TASK, horizon=HORIZON, render_mode="rgb_array")


def test_it_does_what_sb3s_own_gathering_of_single_environments_does(envs):
    one = SubterraEnv(TASK, horizon=HORIZON)
    theirs = DummyVecEnv([lambda: copy.copy(one)] * 2)
    for vec in (envs, theirs):
        vec.seed(3)
    np.testing.assert_allclose(envs.reset(), theirs.reset(), atol=1e-3)
    endings = set()
    for _ in range(50):
        ours, other = envs.step(ACTIONS), theirs.step(ACTIONS)
        np.testing.assert_allclose(ours[0], other[0], atol=2e-3)
        np.testing.assert_allclose(ours[1], other[1], atol=1e-4)
        np.testing.assert_array_equal(ours[2], other[2])
        assert ours[1].dtype == other[1].dtype
        for a, b, done in zip(ours[3], other[3], ours[2], strict=True):
            assert set(a) == set(b)
            assert a["TimeLimit.truncated"] == b["TimeLimit.truncated"]
            if done:
                endings.add(a["TimeLimit.truncated"])
                np.testing.assert_allclose(a["terminal_observation"], b["terminal_observation"], atol=2e-3)
    assert endings == {True, False}


def test_a_seed_is_used_once_and_repeats_the_episodes(envs):
    def first(seed):
        if seed is not None:
            envs.seed(seed)
        return envs.reset()

    a = first(8)
    np.testing.assert_array_equal(a, first(8))
    assert (a != first(None)).any()


def test_attributes_of_the_batch_and_pictures_of_each_environment(envs):
    envs.reset()
    assert envs.get_attr("render_mode") == ["rgb_array"] * 2
    assert not envs.has_attr("wheels")
    envs.set_attr("label", "left")
    assert envs.get_attr("label", 0) == ["left"]
    with pytest.raises(AttributeError, match="no method 'compute_reward'"):
        envs.env_method("compute_reward")
    assert envs.render().shape == (960, 480, 3)
    assert envs.env_is_wrapped(VecMonitor) == [False, False]


def test_ppo_takes_a_few_updates_through_sb3s_wrappers():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        # As many as above, so that nothing is compiled anew.
        monitored = VecNormalize(VecMonitor(SubterraVecEnv(2, TASK, horizon=HORIZON), info_keywords=("success",)))
        model = PPO("MlpPolicy", monitored, n_steps=64, batch_size=64, n_epochs=1, seed=0, device="cpu")
        weights = [w.detach().clone() for w in model.policy.parameters()]
        model.learn(2 * 64 * 2)
    finally:
        torch.set_num_threads(before)
    assert any((w != old).any() for w, old in zip(model.policy.parameters(), weights, strict=True))
    episodes = model.ep_info_buffer
    assert len(episodes) >= 8
    assert max(episode["l"] for episode in episodes) == HORIZON
    assert all(not episode["success"] for episode in episodes)


def test_a_task_with_named_fields_suits_the_policy_for_dicts():
    task = "Subterra/StopAtShort-v1"
    assert set(SubterraVecEnv(2, task).observation_space.keys()) >= {"ranges", "odometry", "goal"}
    assert SubterraVecEnv(2, task, flat=True).observation_space.shape == (21,)


def world():
    """A straight tunnel and a small image, for quick compiling."""
    xy = np.stack([np.linspace(0.0, 40.0, 41), np.zeros(41)], axis=-1)
    made = make_sensor("spin16x64")
    rays = np.asarray(made.directions).reshape(16, 64, 3)[::4, ::8].reshape(-1, 3)
    sensor = make_sensor(rays, shape=(4, 8))
    return {"tunnel": st.tunnel.from_centreline(xy, 2.8), "sensor": sensor}


def test_spaces_and_observations_have_the_shape_of_the_image():
    task = Task(*st.make(TASK, **world()))
    assert task.observation_space["scan"].shape == (4, 8)
    vector = np.arange(3 * 34, dtype=np.float32).reshape(3, 34)
    seen = as_observation(vector, task.fields)
    assert seen["scan"].shape == (3, 4, 8)
    assert seen["odometry"].shape == (3, 2)
    np.testing.assert_array_equal(seen["scan"][1, 2], vector[1, 16:24])
    assert Task(*st.make(TASK, tunnel=world()["tunnel"])).fields is None


@pytest.mark.slow
def test_one_environment_and_a_batch_give_the_same_images_within_their_space():
    env = SubterraEnv(TASK, **world())
    obs, _ = env.reset(seed=3)
    assert list(obs) == ["scan", "odometry"]
    assert obs["scan"].shape == (4, 8)
    assert env.observation_space["scan"].shape == (4, 8)
    after, *_ = env.step(np.array([1.0, 0.0], np.float32))
    assert env.observation_space.contains(after)
    assert np.ptp(after["scan"]) > 1.0
    sb3 = pytest.importorskip("stable_baselines3")
    from subterra_jax.adapters.sb3 import SubterraVecEnv

    envs = SubterraVecEnv(2, TASK, **world())
    envs.seed(3)
    batch = envs.reset()
    assert batch["scan"].shape == (2, 4, 8)
    np.testing.assert_allclose(batch["scan"][0], obs["scan"], atol=1e-3)
    policy = sb3.PPO("MultiInputPolicy", envs, n_steps=8, batch_size=8, device="cpu")
    action, _ = policy.predict(batch)
    assert action.shape == (2, 2)


def colours(picture):
    assert picture.shape == (480, 480, 3)
    assert picture.dtype == np.uint8
    return {tuple(int(c) for c in colour) for colour in np.unique(picture.reshape(-1, 3), axis=0)}


@pytest.fixture(scope="module")
def fresh():
    env, params = st.make("Subterra/Obstructed-v1", "subterra-351")
    obs, state = jax.device_get(jax.jit(env.reset)(jax.random.key(1), params))
    return env, params, state, obs


def at(fresh, station):
    """The picture with the robot elsewhere on the centreline."""
    env, params, state, obs = fresh
    row = round(station / float(params.tunnel.spacing))
    moved = state.replace(position=np.asarray(params.tunnel.grid[row, :2]), station=np.float32(station))
    return colours(make_view("top").picture(env, params, moved, obs))


def test_the_plan_shows_walls_beams_and_robot(fresh):
    assert at(fresh, 0.0) >= {drawing.BACKGROUND, drawing.WALL, drawing.BEAM, drawing.ROBOT}


def test_the_goal_and_the_boxes_are_shown_where_they_are_near(fresh):
    goal = float(fresh[2].goal.station)
    assert drawing.GOAL in at(fresh, goal - 5.0)
    assert drawing.GOAL not in at(fresh, goal - 20.0 if goal > 30.0 else goal + 20.0)
    start = float(fresh[2].station)  # boxes stand ahead of it
    assert any(drawing.BOX in at(fresh, start + ahead) for ahead in (15.0, 30.0, 45.0))


def test_a_box_and_a_goal_are_drawn_where_they_are():
    boxes = Boxes(centre=np.array([[3.0, 4.0]]), axis=np.array([[0.0, 1.0]]), half=np.array([[1.0, 0.5]]))
    goal = np.array([[-5.0, -2.0], [-5.0, 2.0]])
    picture = drawing.top_down(
        np.zeros((0, 2)), np.zeros(2), 0.0, 0.4, np.zeros(4), view=24.0, size=240, goal=goal, boxes=[boxes]
    )
    rows, columns = np.nonzero((picture == drawing.BOX).all(axis=2))
    x, y = (columns + 0.5 - 120) / 10, (120 - rows - 0.5) / 10
    assert [x.min(), x.max(), y.min(), y.max()] == pytest.approx([2.5, 3.5, 3.0, 5.0], abs=0.11)
    rows, columns = np.nonzero((picture == drawing.GOAL).all(axis=2))
    assert np.ptp(rows) == pytest.approx(40, abs=2)
    assert np.abs((columns + 0.5 - 120) / 10 + 5.0).max() < 0.2


def test_a_leaf_of_another_width_is_refused():
    with pytest.raises(TypeError, match="float16"):
        pack({"half": jnp.zeros(2, jnp.float16)})


def test_a_function_of_many_operations_becomes_one_call_with_the_same_result():
    def many(x):
        key = jax.random.wrap_key_data(jnp.array([0, 7], jnp.uint32))
        noisy = x + jax.random.normal(key, x.shape)
        return jnp.cumsum(jnp.sin(noisy)), jnp.min(jnp.abs(noisy), keepdims=True)

    x = np.linspace(0.0, 1.0, 300, dtype=np.float32)
    compiled = compile_as_one_kernel(many, x)
    for got, expected in zip(compiled(x), jax.jit(many)(x), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-6)  # sums of numbers of order one
    entry = compiled.as_text().split("ENTRY", 1)[1]
    assert "fusion(" not in entry
    assert entry.count(" call(") == 1


def test_what_cannot_be_one_kernel_is_compiled_in_the_usual_way():
    x = np.array([3.0, 1.0, 2.0], np.float32)
    np.testing.assert_array_equal(compile_as_one_kernel(jnp.sort, x)(x), [1.0, 2.0, 3.0])


def test_seeds_begin_different_streams_and_only_legal_seeds_are_taken():
    streams = start_streams([0, 1, 2**32, None, None], np.random.default_rng(0))
    assert len(np.unique(streams, axis=0)) == 5
    np.testing.assert_array_equal(streams[2], [1, 0])
    for seed in (-1, 2**64):
        with pytest.raises(ValueError, match=str(seed)):
            start_streams([seed], np.random.default_rng(0))
