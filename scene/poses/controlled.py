"""Where the LiDAR was: from position control, IMU and odometry together."""

import functools
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scene.cli import Stages
from scene.errors import RecordingError
from scene.poses.attitude import find_inertial
from scene.poses.calibration import Calibration, Mount
from scene.poses.chain import Chain
from scene.poses.control import MIN_SHARE, Control
from scene.poses.imu import Inertial
from scene.poses.located import Located, track
from scene.poses.problem import Noise, Problem, solve_with_heading
from scene.poses.smoother import inertial_problem, odometry_problem, steps_of_imu
from scene.poses.tracker import LIBRARY, Guide
from scene.poses.trajectory import Trajectory
from scene.reading.recording import Recording
from scene.resume import Partial

# Guides: what is trusted of the turn (rad) and the shift (m) from one sweep to the next.
_BY_CONTROL = (np.deg2rad(0.1), 0.02)
_BY_CONTROL_WITHOUT_IMU = (np.deg2rad(0.5), 0.02)
_OUTLIER = 4.0  # standard deviations
_END = 0.05  # m; an end of the bore is found to this, on simulated surveys


def by_control(
    recording: Recording, control: Control, calibration: Calibration, progress: Stages, partial: Partial
) -> Located:
    """All that was measured, in the control's frame.

    Raises:
        RecordingError: The control does not overlap the recording.
        FitError: Too few scans, or what was measured does not determine the trajectory.
    """
    start, end = _span(recording)
    control.require_overlap(start, end, recording.path)
    inertial, mount = find_inertial(recording, calibration)
    if inertial and mount:
        problem, chain = _with_imu(recording, inertial, mount, control, calibration, progress, partial)
        trajectory = _lidar_poses(chain, mount)
    else:
        problem, chain = _without_imu(recording, control, calibration, progress, partial)
        trajectory = _lidar_poses(chain, Mount(np.eye(3), np.zeros(3)))
    return Located(
        trajectory,
        {
            "poses": f"control, {LIBRARY}" + (f", IMU {inertial.topic}" if inertial else ""),
            "imu": inertial.topic if inertial else None,
            "calibration": calibration.name,
            "prism_lever": calibration.prism,
            **_control_facts(problem, chain, control),
        },
        # Control often starts late and ends early; what it does not reach is left out, and counted.
        most_uncovered=1 - MIN_SHARE,
    )


def _with_imu(
    recording: Recording,
    inertial: Inertial,
    mount: Mount,
    control: Control,
    calibration: Calibration,
    progress: Stages,
    partial: Partial,
) -> tuple[Problem, Chain]:
    lever = mount.rotation @ calibration.prism + mount.shift
    problem, chain = inertial_problem(inertial, control, lever, Noise())
    guess = _kept(partial, "smoothed", lambda: solve_with_heading(problem, chain), progress)
    odometry = track(recording, Guide(_lidar_poses(guess, mount), True, *_BY_CONTROL), progress, partial)
    whole = replace(problem, steps=steps_of_imu(odometry, guess, mount))
    return whole, _kept(partial, "smoothed-again", lambda: whole.solve(guess)[0], progress)


def _without_imu(
    recording: Recording, control: Control, calibration: Calibration, progress: Stages, partial: Partial
) -> tuple[Problem, Chain]:
    """Twice: the first smoothing guides the second odometry, which then slips and smears less."""
    guide = None
    for turn in ("first", "second"):
        odometry = track(recording, guide, progress, partial, turn)
        problem, guess = odometry_problem(odometry, control, calibration.prism, Noise())
        chain = _kept(partial, f"smoothed-{turn}", functools.partial(solve_with_heading, problem, guess), progress)
        guide = Guide(_lidar_poses(chain, Mount(np.eye(3), np.zeros(3))), True, *_BY_CONTROL_WITHOUT_IMU)
    return problem, chain


def _control_facts(problem: Problem, chain: Chain, control: Control) -> dict[str, Any]:
    """Residuals of the control, and what they say of the length and the length they allow, 95 %."""
    residual = problem.sightings.residual(chain)
    kept = np.linalg.norm(residual, axis=1) < _OUTLIER * np.sqrt(3) * problem.sightings.sigma
    rms = float(np.sqrt(np.mean(residual[kept] ** 2))) if kept.any() else float("inf")
    trusted = max(rms, problem.noise.control)
    return {
        "length_fixed_by": "control",
        "length_uncertainty": float(np.sqrt(2) * np.hypot(2 * trusted, _END)),
        "length_uncertainty_from": "95 %: control residuals, and how well ends are found; not the control's own scale",
        "control_rows": len(residual),
        "control_rows_repeated": control.dropped,
        "control_outliers": int((~kept).sum()),
        "control_residual_rms": rms,
        "control_longest_gap": float(np.diff(control.times).max()),
    }


def _lidar_poses(chain: Chain, mount: Mount) -> Trajectory:
    attitude = chain.attitude @ mount.rotation
    return Trajectory(
        chain.times, chain.position + chain.attitude @ mount.shift, Rotation.from_matrix(attitude), LIBRARY
    )


def _kept(partial: Partial, name: str, solve: Callable[[], Chain], progress: Stages) -> Chain:
    """A smoothed trajectory, from the partial results where an earlier build got so far."""
    stage = progress.start("smoothing the trajectory", 1)
    known = partial.load(name)
    chain = Chain(**known) if known else solve()
    # One memory layout whether read back or not: the order of later sums may depend on it.
    arrays = {field.name: np.ascontiguousarray(getattr(chain, field.name)) for field in fields(Chain)}
    if not known:
        partial.save(name, **arrays)
    stage.advance()
    return Chain(**arrays)


def _span(recording: Recording) -> tuple[float, float]:
    """Times of the first and the last scan, s, without reading the scans where the file knows them."""
    times = [scan.stamp for scan in recording.scans()]
    if len(times) < 2:
        raise RecordingError(f"{recording.path}: holds {len(times)} scans; at least 2 are needed")
    return times[0], times[-1]
