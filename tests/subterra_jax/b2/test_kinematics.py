"""Leg kinematics and statics against MuJoCo."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from subterra_jax.b2 import constants as b2
from subterra_jax.b2 import kinematics
from subterra_jax.b2.model import robot_spec

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
