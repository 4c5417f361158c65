"""The gait's plan of feet; leg kinematics and statics against MuJoCo."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.b2 import constants as b2
from subterra_jax.b2 import gait, kinematics
from subterra_jax.b2.model import robot_spec
from subterra_jax.b2.tasks import make
from subterra_jax.b2.walk import command_joints
from subterra_jax.policies import load
from tests.subterra_jax.b2.conftest import N_ROBOTS

PERIOD, DOWN = 0.02, jnp.array([0.0, 0.0, -1.0])
PARAMS = gait.GaitParams()
stance, foot_targets, targets = jax.jit(gait.stance), jax.jit(gait.foot_targets), jax.jit(gait.targets)
advance = jax.jit(gait.advance)


def follow(command, seconds, drift=(0.0, 0.0, 0.0)):
    """States of the gait under a constant command."""
    command, drift = jnp.asarray(command), jnp.asarray(drift)
    states = [gait.standing_gait(jnp.float32(0.1))]
    for _ in range(round(seconds / PERIOD)):
        states.append(advance(states[-1], command, drift, PERIOD, PARAMS))
    return states


def test_without_a_command_every_foot_stays_on_the_ground():
    last = follow((0.0, 0.0, 0.0), 1.0)[-1]
    assert float(last.stride) == 0.0
    np.testing.assert_allclose(stance(last, PARAMS), 1.0)
    feet = foot_targets(last, DOWN, PARAMS)
    np.testing.assert_allclose(feet[:, 2], feet[0, 2])
    np.testing.assert_allclose(feet[:, 0], 0.0, atol=1e-7)


def test_diagonal_legs_step_together():
    for state in follow((0.8, 0.0, 0.0), 1.0)[20:]:
        on = stance(state, PARAMS)
        assert float(on[0]) == float(on[3])
        assert float(on[1]) == float(on[2])
        assert float(on[0] + on[1]) >= 0.9
    assert all(float(follow(0.6 * way, 0.3)[-1].stride) == 1.0 for way in np.eye(3))


def test_a_foot_on_the_ground_goes_back_as_fast_as_the_robot_is_to_go_forward():
    states = follow((0.8, 0.0, 0.0), 3.0)
    speeds = []
    for before, after in itertools.pairwise(states[100:]):
        standing = (np.asarray(stance(before, PARAMS)) == 1.0) & (np.asarray(stance(after, PARAMS)) == 1.0)
        moved = foot_targets(after, DOWN, PARAMS) - foot_targets(before, DOWN, PARAMS)
        speeds += list(np.asarray(moved)[standing, 0] / PERIOD)
    assert len(speeds) > 50
    np.testing.assert_allclose(speeds, -0.8, atol=1e-3)


def test_a_lifted_foot_clears_a_sleeper():
    highest = max(float(foot_targets(s, DOWN, PARAMS)[0, 2]) for s in follow((0.5, 0.0, 0.0), 2.0)[20:])
    assert highest - (0.032 - PARAMS.height) > 0.06 + 0.03


def test_a_robot_that_is_too_slow_is_told_to_take_longer_strides():
    slow = follow((0.8, 0.0, 0.0), 1.0, drift=(-0.3, 0.0, 0.0))[-1]
    assert 0.0 < float(slow.trim[0]) <= PARAMS.trim_max
    assert float(slow.offset[0, 0]) < 0.0  # set down further back, it falls forward


def test_servos_lead_by_what_the_load_costs_them():
    standing = follow((0.0, 0.0, 0.0), 0.5)[-1]
    expected = kinematics.joint_angles(foot_targets(standing, DOWN, PARAMS))
    lead = targets(standing, DOWN, PARAMS).reshape(4, 3) - expected
    torque = lead * kinematics.STIFFNESS
    # Carried by all four: as much as a quarter of the weight asks of the calf.
    depth = 0.35 * np.sin(-(expected[0, 1] + expected[0, 2])) * np.cos(expected[0, 0])
    np.testing.assert_allclose(torque[:, 2], depth * 74.5803 * 9.81 / 4.0, rtol=1e-3)


def test_the_command_is_approached_no_faster_than_the_slew_allows():
    velocities = np.array([s.velocity for s in follow((1.0, 0.3, 0.8), 1.5)])
    most = np.abs(np.diff(velocities, axis=0)).max(axis=0)
    np.testing.assert_allclose(most, np.array(PARAMS.slew) * PERIOD, rtol=1e-3)
    np.testing.assert_allclose(velocities[-1], (1.0, 0.3, 0.8), rtol=1e-5)


ANGLES = np.random.default_rng(0).uniform([-0.6, -0.3, -2.4], [0.6, 1.5, -0.6], (4, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def posed():
    model = robot_spec().compile()
    data = mujoco.MjData(model)
    data.qpos[3], data.qpos[7:] = 1.0, ANGLES.ravel()
    mujoco.mj_forward(model, data)
    return model, data


def test_feet_are_where_mujoco_has_them(posed):
    _, data = posed
    expected = np.stack([data.site(f"{leg}_foot").xpos for leg in b2.LEGS])
    np.testing.assert_allclose(kinematics.HIPS + kinematics.foot_positions(jnp.asarray(ANGLES)), expected, atol=1e-6)


def test_angles_are_the_inverse_of_feet():
    np.testing.assert_allclose(
        kinematics.joint_angles(kinematics.foot_positions(jnp.asarray(ANGLES))), ANGLES, atol=2e-6
    )


def test_a_foot_out_of_reach_is_reached_for_without_a_nan():
    far = jnp.tile(jnp.array([[0.5, 0.12, -0.9]]), (4, 1))
    found = kinematics.joint_angles(far)
    assert np.isfinite(found).all()
    assert np.linalg.norm(kinematics.foot_positions(found)[0]) < 0.71


def test_feet_move_as_mujocos_jacobian_says(posed):
    model, data = posed
    speeds = np.random.default_rng(1).normal(size=(4, 3)).astype(np.float32)
    for index, leg in enumerate(b2.LEGS):
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jacobian, None, data.site(f"{leg}_foot").id)
        expected = jacobian[:, 6:] @ speeds.ravel()
        motion = kinematics.foot_velocities(jnp.asarray(ANGLES), jnp.asarray(speeds))[index]
        np.testing.assert_allclose(motion, expected, atol=2e-6)


def test_the_calf_carries_a_quarter_of_the_robot_with_41_newton_metres():
    """0.35 m × sin 0.7 rad × 74.58 kg × 9.81 m/s² / 4."""
    pose = jnp.asarray(kinematics.standing_pose()[0]).reshape(4, 3)
    torque = kinematics.load_torques(pose, jnp.full(4, b2.TOTAL_MASS * 9.81 / 4.0))
    np.testing.assert_allclose(torque[:, 2], 0.35 * np.sin(0.7) * 74.5803 * 9.81 / 4.0, rtol=1e-4)
    np.testing.assert_allclose(torque[0, 0], -torque[1, 0], rtol=1e-5)


@pytest.fixture(scope="module")
def in_c():
    env, _ = make(engine="mujoco")
    return env.physics


@pytest.fixture(scope="module")
def moment(walking):
    """Eight robots on their way, where their anchors lie, and where their servos are to go."""
    params = walking.commanded((0.5, 0.0, 0.0))
    aims = jax.jit(jax.vmap(lambda s: command_joints(s, jnp.zeros(12), PERIOD, params)[1]))

    def seen(state):
        origin = params.track.position[state.anchor]
        return jax.device_get((state.body, aims(state), origin, state.build))

    _, state = walking.reset(3, params)
    for k in range(20):
        _, state, *_ = walking.step(k, state, params=params)
    return params, state, seen


def of(tree, k):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[k], tree)


@pytest.mark.slow
def test_half_a_second_in_both_engines_ends_in_nearly_the_same_pose(walking, moment, in_c):
    """From one state and the same targets, 125 steps of physics: in C on the tunnel's own boxes, in MJX on planes."""
    params, state, seen = moment
    robots, bodies = range(3), of(state.body, slice(3))
    shift = np.zeros((3, 3), np.float32)
    for k in range(25):
        _, aims, origin, build = seen(state)
        before = state
        _, state, _, terminated, truncated, _ = walking.step(100 + k, state, params=params)
        assert not (terminated | truncated)[:3].any()
        # A robot that has passed on to another anchor is distinguished from there.
        track = params.track.position
        after = [in_c.bench.run(of(bodies, r), aims[r], origin[r], of(build, r), in_c.substeps) for r in robots]
        bodies = jax.tree.map(lambda *parts: np.stack(parts), *after)
        shift = np.asarray(track[state.anchor] - track[before.anchor])[:3]
        bodies = dataclasses.replace(bodies, qpos=bodies.qpos - np.pad(shift, ((0, 0), (0, 16))))
    np.testing.assert_allclose(bodies.qpos[:, 7:], state.body.qpos[:3, 7:], atol=0.03)
    np.testing.assert_allclose(bodies.qpos[:, :7], state.body.qpos[:3, :7], atol=0.03)
    assert np.abs(np.asarray(state.body.qvel[:3, 6:])).max() > 0.5, "nothing moved"


@pytest.mark.slow
def test_in_ten_seconds_robots_of_both_engines_get_equally_far(walking, moment):
    """Legs are chaotic: from one state, two engines part by metres in 10 s. What stays is how far eight robots get."""
    params, fresh, _ = moment
    low, high = (jnp.array([0.5, 0.0, side], jnp.float32) for side in (-0.8, 0.8))
    steered = dataclasses.replace(walking.params.command, low=low, high=high, still=jnp.float32(0.0))
    params = dataclasses.replace(params, command=steered)
    env, _ = make(engine="mujoco")
    in_c, act, far = jax.jit(st.AutoReset(env).step), jax.jit(load(gait.RELEASED)[0].act), []
    for step in (walking.compiled["step"], in_c):
        state, action, ended = fresh, jnp.zeros((N_ROBOTS, 12)), False
        for k in range(500):
            obs, state, _, terminated, *_ = step(jax.random.key(k), state, action, params)
            action, ended = act(obs), ended | bool(np.any(terminated))
        far.append(np.abs(np.asarray(params.track.station[state.anchor] - params.track.station[fresh.anchor])))
        assert not ended
    assert np.mean(far[0]) == pytest.approx(np.mean(far[1]), rel=0.05)
    assert np.mean(far[0]) > 3.0


@pytest.mark.slow
def test_a_robot_s_step_depends_neither_on_who_was_there_before_nor_on_the_batch(moment, in_c):
    _, state, seen = moment
    what = seen(state)
    alone = [in_c.bench.run(*of(what, k), in_c.substeps) for k in (2, 5, 2)]
    together = in_c.run_rows(*of(what, slice(6)))
    for name in ("qpos", "qvel", "warmstart"):
        assert np.array_equal(getattr(alone[0], name), getattr(alone[2], name))
        assert np.array_equal(getattr(alone[0], name), getattr(together, name)[2])
        assert not np.array_equal(getattr(alone[0], name), getattr(alone[1], name))
