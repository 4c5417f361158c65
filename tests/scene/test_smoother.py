"""Trajectories from control, odometry and IMU: term by term, and on a whole recording."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scene.errors import FitError, Refusal
from scene.poses import imu
from scene.poses.calibration import load_calibration
from scene.poses.imu import GRAVITY, Inertial, integrals
from scene.poses.locate import check_located, locate_by_control, locate_by_odometry
from scene.poses.smoother import Noise, find_control_lag, inertial_problem, means_between, solve_with_heading
from scene.poses.terms import KNOT_SIZE, Chain, Motion, NormalEquations, Sightings, Steps, add_biases, add_motion
from scene.poses.trajectory import Control, load_control
from scene.progress import Stages
from scene.reading.recording import Recording
from tests.recorded import check
from tests.scene import walks
from tests.scene.fits import TABLE, keep
from tests.scene.surveyed import load_trajectory, survey

DURATION = 24.0


def errors(chain: Chain, mounted: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Attitude, degrees, and position, m, against the walk."""
    twist = walks.attitude(chain.times, mounted).inv() * Rotation.from_matrix(chain.attitude)
    return np.rad2deg(twist.as_rotvec()), chain.position - walks.position(chain.times)


@pytest.mark.parametrize("mounted", [0.0, -2.5])
def test_prism_and_imu_give_place_and_attitude_however_the_imu_is_mounted(mounted):
    problem, guess = inertial_problem(
        walks.inertial(DURATION, mounted), walks.control(DURATION, mounted), walks.LEVER, Noise()
    )
    chain = solve_with_heading(problem, guess)
    twist, off = errors(chain, mounted)
    keep({"twist": twist, "off": off, "bias": chain.accel_bias}, rel=1e-3)
    assert np.sqrt(np.mean(twist**2, axis=0)).max() < 0.3
    assert np.sqrt(np.mean(off**2)) < 0.003
    np.testing.assert_allclose(chain.gyro_bias[-1], 0.003, atol=1e-3)


def test_the_clock_of_a_control_is_told_by_the_motion_that_it_shares_with_the_imu():
    control = walks.control(18.0)
    control = replace(control, times=control.times - 0.076)  # between the lags that are tried
    problem, guess = inertial_problem(walks.inertial(18.0), control, walks.LEVER, Noise())
    lag = find_control_lag(problem, problem.solve(guess)[0], control)
    assert lag == pytest.approx(-0.076, abs=0.002)
    json.dumps(lag > 0.0)  # a manifest holds no number of NumPy


def test_a_carrier_that_glides_tells_no_clock():
    times = np.arange(0.0, DURATION, 0.005)
    even = np.column_stack([1.0 * times, 0.0 * times, 0.0 * times])
    inertial = Inertial(times, 0.0 * even, np.tile([0.0, 0.0, GRAVITY], (len(times), 1)), "/imu")
    control = Control(times[40:-40:66], even[40:-40:66] + walks.LEVER, Path("prism.tum"), 0)
    problem, guess = inertial_problem(inertial, control, walks.LEVER, Noise())
    assert find_control_lag(problem, problem.solve(guess)[0], control) is None


def test_a_control_row_that_is_wrong_by_a_metre_moves_the_trajectory_by_millimetres():
    control = walks.control(DURATION)
    control.positions[40] += (0.0, 1.0, 0.0)
    problem, guess = inertial_problem(walks.inertial(DURATION), control, walks.LEVER, Noise())
    _, off = errors(solve_with_heading(problem, guess))
    assert np.abs(off).max() < 0.015


def test_samples_are_integrated_by_the_trapezium_rule():
    times, values = np.array([0.0, 1.0, 3.0]), np.array([[0.0, 1.0, 2.0], [1.0, 1.0, 0.0], [3.0, 1.0, 0.0]])
    np.testing.assert_allclose(integrals(times, times, values), [[0, 0, 0], [0.5, 1, 1], [4.5, 3, 1]])
    np.testing.assert_allclose(means_between(times, times, values), [[0.5, 1, 1], [2, 1, 0]])


class Recorder:
    """Keeps what terms add: residuals, and by knots the jacobians."""

    def __init__(self):
        self.terms = []

    def add(self, residual, *parts):
        self.terms.append((residual, zip(parts[::2], parts[1::2], strict=True)))


def small_chain() -> Chain:
    rng = np.random.default_rng(1)
    times = 0.1 * np.arange(4.0)
    near = [1e-3 * rng.standard_normal((4, 3)) for _ in range(4)]
    return Chain(times, walks.attitude(times).as_matrix(), walks.position(times) + near[0], 1 + near[1], *near[2:])


def terms():
    rng = np.random.default_rng(2)
    ends = np.arange(3), np.arange(1, 4)
    chain = small_chain()
    turn = chain.attitude[:-1].mT @ chain.attitude[1:]
    unit = np.broadcast_to(np.eye(3), (3, 3, 3))
    motion = Motion(rng.standard_normal((3, 3)) * 0.1, rng.standard_normal((3, 3)) + np.array([0, 0, 9.8]), 1.0, 1.0)
    seen = Sightings(np.array([0, 1, 2]), np.array([0.0, 0.5, 0.9]), chain.position[:3], walks.LEVER, 1.0)
    steps = Steps(*ends, turn, rng.standard_normal((3, 3)), unit, unit)
    return {
        "motion": lambda sink, at: add_motion(sink, at, motion, 1.0),
        "sightings": lambda sink, at: seen.add_to(sink, at, 1e9),
        "steps": lambda sink, at: steps.add_to(sink, at, 1e9),
        "biases": lambda sink, at: add_biases(sink, at, (0.5, 0.4), (0.3, 0.2)),
    }


@pytest.mark.parametrize("name", ["motion", "sightings", "steps", "biases"])
def test_written_out_derivatives_agree_with_finite_differences(name):
    add, chain, h = terms()[name], small_chain(), 1e-6
    here = Recorder()
    add(here, chain)
    for number, (residual, parts) in enumerate(here.terms):
        for term, knot, jacobian in ((k, *one) for part in parts for k, one in enumerate(zip(*part, strict=True))):
            for unknown in range(KNOT_SIZE):
                step, moved = np.zeros((4, KNOT_SIZE)), Recorder()
                step[knot, unknown] = h
                add(moved, chain.after(step))
                slope = (moved.terms[number][0][term] - residual[term]) / h
                # The turn half way, and the half turn of the force, are linearised to first order in a small angle.
                np.testing.assert_allclose(slope, jacobian[:, unknown], atol=0.02)


def test_the_banded_solution_is_the_dense_one():
    rng = np.random.default_rng(0)
    equations = NormalEquations(5, 2, 2)
    rows, right = [], []
    for first, second in [(0, 1), (1, 2), (0, 2), (2, 4), (3, 4), (1, 3)]:
        left, other, residual = rng.standard_normal((3, 2)), rng.standard_normal((3, 2)), rng.standard_normal(3)
        equations.add(residual[None], np.array([first]), left[None], np.array([second]), other[None])
        row = np.zeros((3, 10))
        row[:, 2 * first : 2 * first + 2], row[:, 2 * second : 2 * second + 2] = left, other
        rows.append(row)
        right.append(-residual)
    expected = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
    np.testing.assert_allclose(equations.solve().ravel(), expected, rtol=1e-8)


def test_what_nothing_determines_is_an_error():
    equations = NormalEquations(2, 2, 1)
    equations.add(np.ones((1, 1)), np.array([0]), np.ones((1, 1, 2)))
    with pytest.raises(FitError) as raised:
        equations.solve()
    assert raised.value.code is Refusal.POSES


def test_the_imu_in_the_housing_of_a_lidar_levels_it(monkeypatch):
    own = Inertial(np.arange(2.0), np.zeros((2, 3)), np.full((2, 3), [3.0, 0.0, 9.3]), "/livox/imu")
    monkeypatch.setattr(imu, "imu_topics", lambda _: ["/imu/data", own.topic])
    monkeypatch.setattr(imu, "read_inertial", lambda _, topic: own if topic == own.topic else None)
    turn = imu.level_rotation(SimpleNamespace(topic="/livox/lidar"), None, None, None)
    np.testing.assert_allclose(turn.apply(own.force[0])[:2], 0.0, atol=1e-9)


@pytest.fixture(scope="module", params=[0.0, 0.3])
def recorded(request, tmp_path_factory):
    """Delay of the IMU's clock, s, a walk through a bore, its folder, and its true poses."""
    words = ("--length", 10.5, "--seed", 4, "--point-rate", 24000, "--speed", 3, "--imu-late", request.param)
    folder = survey(tmp_path_factory.mktemp("walk"), *words)
    with Recording(folder / "survey.bag") as bag:
        yield request.param, bag, folder, load_trajectory(folder / "groundtruth.tum")


def test_a_prism_fixes_poses_to_millimetres_once_the_clock_of_the_imu_is_set_right(recorded):
    late, bag, folder, truth = recorded
    mounts, control = load_calibration(folder / "calibration.yaml"), load_control(folder / "prism.tum")
    found = check_located(bag, locate_by_control(bag, control, mounts, Stages(), auto=True))
    facts, poses = found.facts, found.trajectory
    assert facts["clock_offset"] == pytest.approx(late, abs=0.003)
    assert facts["clock_corrected"] == (late > 0.0)
    position, attitude = truth.at(poses.times)
    off, twist = poses.positions - position, np.rad2deg((attitude.inv() * poses.rotations).magnitude())
    assert np.abs(off).max() < 0.006
    assert twist.max() < 0.6
    assert (facts["control_outliers"], facts["pose_doubt"], facts["clock_doubt"]) == (0, None, None)
    assert facts["control_residual_rms"] == pytest.approx(0.0025, abs=0.001)
    assert facts["length_uncertainty"] == pytest.approx(np.sqrt(2) * np.hypot(2 * 0.003, 0.05))  # 95 %: control, ends
    if not late:
        check(TABLE, "control", {"off": off, "twist": twist, "facts": facts | {"clock_offset": late}}, 0.02)


def test_odometry_is_level_and_says_that_nobody_measured_the_length(recorded):
    late, bag, folder, truth = recorded
    found = locate_by_odometry(bag, load_calibration(folder / "calibration.yaml"), Stages(), auto=True)
    assert "nothing measured the axial scale" in found.facts["length_fixed_by"]
    assert found.facts["length_uncertainty"] is None
    attitude = truth.at(found.trajectory.times)[1]
    turned = attitude * found.trajectory.rotations.inv()  # from its own frame to the survey's
    assert turned.apply([0.0, 0.0, 1.0])[:, 2].min() > np.cos(np.deg2rad(2.0))
    assert np.rad2deg((turned * turned[0].inv()).magnitude()).max() < 2.0
    if not late:
        twist = (turned * turned[0].inv()).as_rotvec()
        check(TABLE, "odometry", {"twist": twist, "path": found.trajectory.positions}, 0.02)
