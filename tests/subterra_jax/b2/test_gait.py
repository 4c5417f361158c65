"""The trot by itself, without physics."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from subterra_jax.b2 import gait, kinematics

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
