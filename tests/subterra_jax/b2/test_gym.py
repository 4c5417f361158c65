"""The B2 in Gymnasium and the mission beneath: one compiled step for all of it."""

import dataclasses
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

import subterra_jax as st
from subterra_jax.adapters.kernel import pack
from subterra_jax.b2 import tasks
from subterra_jax.b2.params import SensorParams
from subterra_jax.baselines.registry import make_agent
from subterra_jax.physics.ground import TrackError
from subterra_jax.physics.rotations import yaw
from subterra_jax.physics.stage import RobotError
from subterra_jax.policies import PolicyError
from subterra_jax.recorder.trace import drive as trace_of
from tests.recorded import check, named

ID = "Subterra/B2Traverse-v1"
QUIET = {"rate": 0.0, "gravity": 0.0, "angle": 0.0, "speed": 0.0}


@pytest.fixture(scope="module")
def plan():
    return st.load_tunnel().slice(0.0, 40.0)


@pytest.fixture(scope="module")
def env(plan):
    """One environment, compiled with less zeal: half the time, the same numbers to rounding."""
    made = gymnasium.make(ID, tunnel=plan, policy="trot", walk={"sensor": SensorParams(**QUIET)})
    quick = {"xla_backend_optimization_level": 0}
    made.unwrapped.task.compile = lambda f, params, *like: partial(
        jax.jit(f).lower(params, *like).compile(quick), params
    )
    return made


def drive(env, action, n_steps, seed=1):
    env.reset(seed=seed)
    return [env.step(np.asarray(action, np.float32)) for _ in range(n_steps)]


def changed(env, **fields):
    """Another state of the environment's robot."""
    inner = env.unwrapped
    stream, state = inner.task.unpack(np.asarray(inner._packed))
    inner._packed = np.asarray(pack((stream, state.replace(**fields))))


def with_body(state, qpos):
    body = dataclasses.replace(state.legs.body, qpos=jnp.asarray(qpos, jnp.float32))
    return dataclasses.replace(state.legs, body=body)


def test_spaces_are_those_of_the_planar_task_and_five_commands_make_a_second(env):
    planar, _ = st.make("Subterra/Traverse-v1")
    assert env.observation_space.shape == (18,)
    np.testing.assert_allclose(env.action_space.high, [0.8, 0.8])
    np.testing.assert_allclose(env.action_space.low, [0.0, -0.8])
    assert env.unwrapped.task_env.rule == planar.rule
    assert env.metadata["render_fps"] == 5


def test_a_chosen_start_is_refused_in_one_sentence(env):
    with pytest.raises(ValueError, match="a reset of Subterra/B2Traverse-v1 takes no options, got 'start'"):
        env.unwrapped.reset(options={"start": 5.0})


def test_told_to_walk_it_walks_and_its_legs_know_how_far(env):
    outcome = drive(env, (0.6, 0.0), 20)
    start, info, obs = outcome[4][4]["station"], outcome[-1][4], outcome[-1][0]
    assert not any(step[2] for step in outcome)
    assert 1.0 < info["station"] - start < 2.5  # in 3 s
    walked = info["station"] - 2.0
    assert obs[16] == pytest.approx(walked, rel=0.15)
    assert isinstance(info["station"], float)
    assert isinstance(info["fall"], bool)
    paid = sum(value for name, value in info.items() if name.startswith("reward_"))
    assert outcome[-1][1] == pytest.approx(paid, rel=1e-4)


def test_told_to_stand_it_stands_and_a_nan_is_a_zero(env):
    assert env.metadata["render_fps"] == 5
    outcome = drive(env, (0.0, 0.0), 15)
    assert abs(outcome[-1][4]["station"] - outcome[9][4]["station"]) < 0.02  # once the feet are settled
    again = drive(env, (np.nan, np.nan), 15)
    np.testing.assert_array_equal(outcome[-1][0], again[-1][0])


def test_the_same_seed_gives_the_same_walk_and_another_one_another(env):
    walks = [np.stack([step[0] for step in drive(env, (0.5, 0.2), 4, seed)]) for seed in (7, 7, 8)]
    np.testing.assert_array_equal(walks[0], walks[1])
    check(__file__, "walk", {"seen": walks[0], "other": walks[2]}, 5e-3)
    assert not np.array_equal(walks[0], walks[2])


def test_a_trace_has_the_poses_of_the_legs(plan):
    env, params = st.make(ID, plan, policy="trot", engine="mujoco")
    trace = trace_of(env, params, make_agent("dead-reckoning", params), 3, steps=2)
    assert trace.pose.shape == (3, 10, 19)
    seen = {"pose": trace.pose[:, :, :3], "joints": trace.pose[:, :, 7:], "seen": trace.observation}
    check(__file__, "trace", {**seen, "state": named(trace.state)}, 5e-3)


def test_a_fall_ends_the_episode_and_is_no_success(env):
    env.reset(seed=0)
    state = env.unwrapped.state
    qpos = np.array(state.legs.body.qpos)
    qpos[3:7] = [np.cos(0.8), np.sin(0.8), 0.0, 0.0]
    changed(env, legs=with_body(state, qpos))
    _, _, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert terminated
    assert not truncated
    assert info["fall"]
    assert not info["success"]


def test_a_wall_stops_the_robot_and_ends_the_episode(env, plan):
    env.reset(seed=0)
    state, params = env.unwrapped.state, env.unwrapped.task_params
    at = np.argmin(np.abs(plan.station - 2.0))
    lateral = float(plan.half_width[at]) - 0.3
    normal = np.array([-plan.tangent[at, 1], plan.tangent[at, 0]])
    qpos = np.array(state.legs.body.qpos)
    qpos[:2] += (lateral - float(state.lateral)) * normal
    turn = float(yaw(state.legs.body.qpos[3:7])) + 1.2
    qpos[3:7] = [np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)]
    changed(env, legs=with_body(state, qpos), lateral=jnp.float32(lateral))
    _, _, terminated, _, info = env.step(np.array([0.8, 0.0], np.float32))
    assert terminated
    assert info["contact"]
    assert not info["success"]
    assert float(params.walk.tunnel.length) == pytest.approx(40.0)


def test_success_is_the_share_of_the_tunnel_that_the_rule_asks_for(env):
    task, near = env.unwrapped.task, env.unwrapped.task_params.replace(goal_coverage=jnp.float32(0.052))
    programs = task.programs
    task.programs = programs._replace(step=partial(programs.step.func, near))
    try:
        outcome = []
        env.reset(seed=2)
        while not (outcome and (outcome[-1][2] or outcome[-1][3])) and len(outcome) < 20:
            outcome.append(env.step(np.array([0.8, 0.0], np.float32)))
    finally:
        task.programs = programs
    assert outcome[-1][2]
    assert outcome[-1][4]["success"]
    assert outcome[-1][4]["coverage"] >= 0.052


def test_gymnasium_knows_the_walking_task_by_its_id(plan):
    inner: Any = gymnasium.make("Subterra/B2Walk-v1", tunnel=plan).unwrapped
    assert (inner.action_space.shape, inner.observation_space.shape) == ((12,), (56,))
    assert inner.walk.physics.period == pytest.approx(0.02)
    assert inner.metadata["render_fps"] == 50
    assert set(inner.action_space.high) == {1.0} == set(-inner.action_space.low)
    with pytest.raises(ResetNeeded):
        inner.step(np.zeros(12))


def test_who_asks_for_what_is_not_there_is_told_in_a_sentence(plan, tmp_path):
    with pytest.raises(PolicyError, match="no-such-gait: no such policy"):
        st.make(ID, plan, policy="no-such-gait")
    with pytest.raises(ValueError, match=r"every 0\.2 s"):
        st.make(ID, plan, policy="trot", vehicle=tasks.VEHICLE.replace(period=0.1))
    with pytest.raises(ValueError, match="no field"):
        st.make(ID, plan, policy="trot", colour=None)
    narrow = dataclasses.replace(plan, half_width=np.full_like(plan.half_width, 0.3))
    with pytest.raises(RobotError, match=r"0\.60 m wide"):
        st.make(ID, narrow, policy="trot")
    shutil.copy(Path(st.__file__).parent / "data" / "subterra-351.npz", tmp_path / "tunnel.npz")
    in_scene = {"scene": tmp_path, "engine": "mujoco"}
    with pytest.raises(TrackError, match=r"scene\.xml is missing"):
        st.make(ID, **in_scene, policy="trot")
    (tmp_path / "scene.xml").write_text('<mujoco><worldbody><geom size="1" contype="8"/></worldbody></mujoco>')
    for asked in ((ID, {}), ("Subterra/Traverse-v1", {"motion": "rover"})):
        for engine in ("mujoco", "mjx"):
            with pytest.raises(TrackError, match="the scene has no floor"):
                st.make(asked[0], **{**in_scene, "engine": engine}, **asked[1])
        with pytest.raises(ValueError, match="either a tunnel or a scene, got both 'metro'"):
            st.make(asked[0], "metro", **in_scene, **asked[1])


def test_a_lidar_in_three_dimensions_stands_on_the_trunk(plan):
    env, params = st.make(ID, tunnel=plan, policy="trot", sensor="spin16x64")
    assert env.images(params) == {"scan": (16, 64)}
    assert env.observation_size(params) == 16 * 64 + 2
    swept = st.parts.make_sensor("vlp16", sweep=True)
    for sensor, sweep in (("spin16x64", True), (swept, False), (swept, True)):
        with pytest.raises(ValueError, match="sweep=True does not go with a robot on legs"):
            st.make(ID, tunnel=plan, policy="trot", sensor=sensor, sweep=sweep)
    with pytest.raises(ValueError, match="Subterra/B2Walk-v1 has the sensor 'planar16' alone"):
        st.make("Subterra/B2Walk-v1", tunnel=plan, sensor="spin16x64")


@pytest.mark.slow
def test_in_gymnasium_the_image_has_its_shape_and_sees_walls_and_ground(plan):
    made = gymnasium.make(ID, tunnel=plan, policy="trot", sensor="spin16x64")
    obs, _ = made.reset(seed=0)
    assert made.observation_space.contains(obs)
    scan = obs["scan"]
    assert scan.shape == (16, 64)
    aside = scan[8, [16, 48]]
    assert aside.sum() == pytest.approx(2.0 * float(np.median(plan.half_width)), abs=0.4)
    assert scan[0, 0] < 4.0 < scan[8, 0]  # 15 degrees down it meets the ballast
    after, *_ = made.step(np.array([0.5, 0.0], np.float32))
    assert made.observation_space.contains(after)
    made.close()
