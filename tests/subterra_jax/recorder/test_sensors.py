"""Poses in three dimensions and an IMU, which the recorder adds to an episode: known answers."""

import dataclasses
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

import subterra_jax as st
from subterra_jax.host import rover
from subterra_jax.recorder.sensors import GRAVITY, Poses, measure_imu, reckoned_poses, true_poses
from subterra_jax.recorder.trace import Trace
from subterra_jax.state import State


@dataclasses.dataclass
class Places:
    """As much of a state as poses need."""

    position: np.ndarray
    heading: np.ndarray
    station: np.ndarray


def trace_of(position, heading, station, period: float = 0.1) -> Trace:
    return of_states(Places(np.asarray(position), np.asarray(heading), np.asarray(station)), len(station), period)


def of_states(states, n, period=0.1):
    """A trace of `n` rows of which the states alone are looked at."""
    nothing = np.zeros(n - 1)
    seen, poses = np.zeros((n, 18)), np.zeros((n, 0, 19))
    return Trace(states, seen, np.zeros((n - 1, 5)), nothing, nothing, np.zeros((n, 0, 3)), poses, period)


def test_on_a_grade_the_robot_is_pitched_by_it_and_facing_back_it_looks_down():
    plan = st.load_tunnel("control")
    plan = dataclasses.replace(plan, elevation=0.03 * plan.station)
    station = np.array([10.0, 50.0])
    tangent = np.stack([np.interp(station, plan.station, plan.tangent[:, i]) for i in range(2)], axis=-1)
    centre = np.stack([np.interp(station, plan.station, plan.centre[:, i]) for i in range(2)], axis=-1)
    heading = np.arctan2(tangent[:, 1], tangent[:, 0]) + np.array([0.0, np.pi])
    poses = true_poses(trace_of(centre, heading, station), plan)
    ahead = poses.rotation.apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(ahead[:, 2], np.array([1.0, -1.0]) * np.sin(np.arctan(0.03)), atol=1e-6)
    np.testing.assert_allclose(poses.rotation.apply([0.0, 1.0, 0.0])[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(poses.position[:, 2], 0.03 * station, atol=1e-9)


def test_a_rover_leans_as_its_trunk_does_over_the_point_where_it_stands():
    turn = Rotation.from_euler("ZYX", [[0.4, 0.2, -0.1]])
    where = np.array([[1.0, 2.0, 0.5]]) + rover.HEIGHT * turn.apply([0.0, 0.0, 1.0])
    body = SimpleNamespace(qpos=np.hstack([where, turn.as_quat()[:, [3, 0, 1, 2]]]))
    ride = SimpleNamespace(body=body, anchor=np.array([1]))
    states = SimpleNamespace(parts={"rover": ride})
    track = SimpleNamespace(position=np.array([[0.0, 0.0, 0.0], [10.0, 20.0, 30.0]]))
    poses = true_poses(of_states(states, 1), st.load_tunnel("control"), track)
    np.testing.assert_allclose(poses.position, [[11.0, 22.0, 30.5]], atol=1e-9)
    np.testing.assert_allclose(poses.rotation.as_matrix(), turn.as_matrix(), atol=1e-9)


def test_an_odometer_without_errors_reckons_the_true_path():
    turn = np.linspace(0.0, 1.4 * np.pi, 60)  # past the wrap of the heading
    step, rate = 0.2, turn[1]
    chord = 2.0 * step / rate * np.sin(rate / 2.0)
    moves = chord * np.stack([np.cos(turn[:-1] + rate / 2.0), np.sin(turn[:-1] + rate / 2.0)], axis=-1)
    true = np.concatenate([[[0.0, 0.0]], np.cumsum(moves, axis=0)])
    reading = np.column_stack([step * np.arange(60), np.arctan2(np.sin(turn), np.cos(turn))])
    poses = reckoned_poses(trace_of(true, turn, turn), reading)
    np.testing.assert_allclose(poses.position[:, :2], true, atol=2e-3 * step * 60)
    np.testing.assert_allclose(poses.rotation.as_rotvec()[10, 2], turn[10], atol=1e-9)


def test_an_imu_on_a_circle_feels_the_turn_the_pull_inwards_and_gravity():
    time, speed, rate = np.arange(0.0, 6.0, 0.1), 2.0, 0.3
    radius = speed / rate
    position = radius * np.stack([np.sin(rate * time), 1.0 - np.cos(rate * time), 0.0 * time], axis=-1)
    poses = Poses(time, position, Rotation.from_rotvec(rate * time[:, None] * np.array([0.0, 0.0, 1.0])))
    true = measure_imu(poses, seed=0, noise=0.0)
    inner = slice(20, -20)
    np.testing.assert_allclose(true.gyro[inner], np.broadcast_to([0.0, 0.0, rate], true.gyro[inner].shape), atol=1e-6)
    expected = np.broadcast_to([0.0, speed * rate, GRAVITY], true.accel[inner].shape)
    np.testing.assert_allclose(true.accel[inner], expected, atol=2e-3)
    noisy = measure_imu(poses, seed=0)
    assert 0.004 < np.std(noisy.gyro[:, 2] - true.gyro[:, 2]) < 0.006
    np.testing.assert_array_equal(measure_imu(poses, seed=0).accel, noisy.accel)


def test_a_state_has_all_that_poses_need():
    assert {field.name for field in dataclasses.fields(Places)} <= {field.name for field in dataclasses.fields(State)}
