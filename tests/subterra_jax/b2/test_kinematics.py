"""Leg kinematics and statics against MuJoCo."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.b2 import constants as b2
from subterra_jax.b2 import kinematics
from subterra_jax.b2.gait import load_policy
from subterra_jax.b2.model import robot_spec
from subterra_jax.b2.tasks import make
from subterra_jax.b2.walk import command_joints
from tests.subterra_jax.b2.conftest import N_ROBOTS

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


PERIOD = 0.02


@pytest.fixture(scope="module")
def in_c():
    env, _ = make(engine="mujoco")
    return env.physics


@pytest.fixture(scope="module")
def moment(walking):
    """Eight robots on their way, where their anchors lie, and where their servos are to go."""
    params = walking.told((0.5, 0.0, 0.0))
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
    params, begun, _ = moment
    low, high = (jnp.array([0.5, 0.0, side], jnp.float32) for side in (-0.8, 0.8))
    steered = dataclasses.replace(walking.params.command, low=low, high=high, still=jnp.float32(0.0))
    params = dataclasses.replace(params, command=steered)
    env, _ = make(engine="mujoco")
    in_c, act, far = jax.jit(st.AutoReset(env).step), jax.jit(load_policy()[0].act), []
    for step in (walking.compiled["step"], in_c):
        state, action, ended = begun, jnp.zeros((N_ROBOTS, 12)), False
        for k in range(500):
            obs, state, _, terminated, *_ = step(jax.random.key(k), state, action, params)
            action, ended = act(obs), ended | bool(np.any(terminated))
        far.append(np.abs(np.asarray(params.track.station[state.anchor] - params.track.station[begun.anchor])))
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
