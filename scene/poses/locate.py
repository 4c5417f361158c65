"""Poses of a recording's LiDAR: given, from odometry alone, or from control with odometry and IMU."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scene.errors import RecordingError
from scene.poses.calibration import Calibration, Mount
from scene.poses.clocks import NOTICED, Clock, find_gap, settle
from scene.poses.consistency import check_poses, reorder
from scene.poses.imu import Inertial, find_inertial, gyro_guide, level_rotation
from scene.poses.odometry import LIBRARY, Guide, estimate_odometry
from scene.poses.smoother import Noise, Problem, find_control_lag, imu_steps, inertial_problem, solve_with_heading
from scene.poses.terms import Chain
from scene.poses.trajectory import Control, Trajectory
from scene.progress import Stages
from scene.reading.formats import ReadingConfig
from scene.reading.recording import Recording


@dataclass(frozen=True)
class Located:
    """Poses of the LiDAR, and their entries in the manifest."""

    # Poses of the LiDAR; in the control's frame where there was one, else level from the first sweep
    trajectory: Trajectory
    # `poses`, `length_fixed_by`, `length_uncertainty` (m, 95 %, or `None` where nobody can say) and figures
    facts: dict[str, Any]
    estimated: bool = True  # True where the poses were estimated here and are written to the scene
    most_uncovered: float = 0.05  # Fraction of the scans that may lie outside the trajectory's time


def _find_timed(
    recording: Recording, calibration: Calibration, auto: bool
) -> tuple[Inertial | None, Mount | None, Clock | None]:
    """Return the IMU with its mount, by the LiDAR's clock where `auto`, and what is known of its clock."""
    inertial, mount = find_inertial(recording, calibration)
    if inertial is None or mount is None:
        return None, None, None
    clock, timed = settle(recording, inertial, auto, mount.rotation)
    return timed if clock.corrected else inertial, mount, clock


def locate_by_odometry(recording: Recording, calibration: Calibration, progress: Stages, auto: bool = False) -> Located:
    """Locates the LiDAR by odometry, helped by the gyro where there is an IMU; raises `FitError` for too few scans.

    With `auto` the clock of the IMU is set right.
    """
    inertial, mount, clock = _find_timed(recording, calibration, auto)
    guide = gyro_guide(inertial, mount) if inertial and mount else None
    stage = progress.start("LiDAR odometry", recording.scan_count)
    trajectory = estimate_odometry(recording, guide, stage).trajectory
    level = level_rotation(recording, trajectory, inertial, mount)
    poses = Trajectory(trajectory.times, level.apply(trajectory.positions), level * trajectory.rotations, LIBRARY)
    facts = {
        "poses": LIBRARY,
        "imu": inertial.topic if inertial else None,
        "length_fixed_by": f"odometry ({LIBRARY}); nothing measured the axial scale",
        "length_uncertainty": None,
        "length_uncertainty_from": "unknown: nobody measured the axial scale",
        **(clock.facts if clock else {}),
    }
    return Located(poses, facts)


# Guides: what is trusted of the turn (rad) and the shift (m) from one sweep to the next.
_BY_CONTROL = (np.deg2rad(0.1), 0.02)
_OUTLIER = 4.0  # standard deviations
_MOST_WITHOUT_CONTROL = 0.5  # fraction of the scans
_END_ERROR = 0.05  # m; an end of the bore is found to this, on simulated surveys


def locate_by_control(
    recording: Recording,
    control: Control,
    calibration: Calibration,
    progress: Stages,
    auto: bool = False,
) -> Located:
    """Locates the LiDAR in the control's frame from control, odometry and IMU, whose clock is set right with `auto`.

    Raises `RecordingError` where the control does not overlap the recording or no IMU is known, and `FitError` for too
    few scans, or where the measurements do not determine the trajectory.
    """
    if recording.scan_count < 2:
        raise RecordingError(f"{recording.path}: holds {recording.scan_count} scans; at least 2 are needed")
    of = f"the control {control.path.name}"
    apart = find_gap(recording, of, control.times, auto)
    control = replace(control, times=control.times - apart)
    inertial, mount, clock = _find_timed(recording, calibration, auto)
    if inertial is None or mount is None or clock is None:
        raise RecordingError(
            f"{control.path}: control goes with an IMU whose mount is known, and {recording.path} has none; "
            "--calibration names it, or --trajectory gives whole poses"
        )
    if not inertial.force.any():
        raise RecordingError(f"{recording.path}: control needs gravity, and {inertial.topic} is without it")
    lever = mount.rotation @ calibration.prism + mount.shift
    problem, guess = _guess(progress, inertial, control, lever)
    lag = find_control_lag(problem, guess, control)
    corrected = auto and lag is not None and abs(lag) >= NOTICED
    if corrected:
        control = replace(control, times=control.times - lag)
        problem, guess = _guess(progress, inertial, control, lever)
    late = 0.0 if clock.corrected else clock.offset or 0.0  # of the IMU, against the LiDAR
    of_control = Clock(of, None if lag is None else lag + late + apart, corrected or apart != 0.0)
    doubts = [words for words in (clock.words, of_control.words) if words]
    stage = progress.start("LiDAR odometry", recording.scan_count)
    odometry = estimate_odometry(recording, Guide(_lidar_poses(guess, mount), True, *_BY_CONTROL), stage)
    problem = replace(problem, steps=imu_steps(odometry, guess, mount))
    chain = _smooth(progress, lambda: problem.solve(guess)[0])
    return Located(
        _lidar_poses(chain, mount),
        {
            "poses": f"control, {LIBRARY}, IMU {inertial.topic}",
            "imu": inertial.topic,
            "calibration": calibration.name,
            "prism_lever": calibration.prism,
            **clock.facts,
            "control_clock_offset": of_control.offset,
            "control_clock_corrected": of_control.corrected,
            "clock_doubt": "; ".join(doubts) or None,
            **_control_facts(problem, chain, control),
        },
        # Control often starts late and ends early; what it does not reach is left out, and counted.
        most_uncovered=_MOST_WITHOUT_CONTROL,
    )


def _guess(progress: Stages, inertial: Inertial, control: Control, lever: np.ndarray) -> tuple[Problem, Chain]:
    """Return what IMU and control measured, and the trajectory of least cost by them alone."""
    problem, chain = inertial_problem(inertial, control, lever, Noise())
    return problem, _smooth(progress, lambda: solve_with_heading(problem, chain))


def _control_facts(problem: Problem, chain: Chain, control: Control) -> dict[str, Any]:
    """Residuals of the control, and the uncertainty of the length that follows (95 %), for the manifest."""
    residual = problem.sightings.residual(chain)
    inlier = np.linalg.norm(residual, axis=1) < _OUTLIER * np.sqrt(3) * problem.sightings.sigma
    rms = float(np.sqrt(np.mean(residual[inlier] ** 2))) if inlier.any() else float("inf")
    trusted = max(rms, problem.noise.control)
    return {
        "length_fixed_by": "control",
        "length_uncertainty": float(np.sqrt(2) * np.hypot(2 * trusted, _END_ERROR)),
        "length_uncertainty_from": "95 %: control residuals, and how well ends are found; not the control's own scale",
        "control_rows": len(residual),
        "control_rows_repeated": control.dropped,
        "control_outliers": int((~inlier).sum()),
        "control_residual_rms": rms,
        "control_longest_gap": float(np.diff(control.times).max()),
    }


def _lidar_poses(chain: Chain, mount: Mount) -> Trajectory:
    attitude = chain.attitude @ mount.rotation
    return Trajectory(
        chain.times, chain.position + chain.attitude @ mount.shift, Rotation.from_matrix(attitude), LIBRARY
    )


def _smooth(progress: Stages, solve: Callable[[], Chain]) -> Chain:
    """Return a smoothed trajectory, as a stage of a build."""
    stage = progress.start("smoothing the trajectory", 1)
    chain = solve()
    stage.advance()
    # One memory layout: the order of later sums may depend on it.
    return Chain(**{field.name: np.ascontiguousarray(getattr(chain, field.name)) for field in fields(Chain)})


_GIVEN = {  # only their maker knows how well they fix the length
    "poses": "given trajectory",
    "length_fixed_by": "given trajectory",
    "length_uncertainty": None,
    "length_uncertainty_from": "not stated: the trajectory came without one",
}


def locate_given(recording: Recording, given: Trajectory, reading: ReadingConfig) -> Located:
    """Takes given poses after a look at what they make of some scans: their clock first, then their quaternions.

    What blurs the walls for another reason is looked for with the clock set right.
    """
    stated, auto = reading.quaternion or given.order, reading.clock == "auto"
    poses = reorder(given) if stated == "wxyz" else given
    clock, timed = settle(recording, poses, auto)
    check = check_poses(recording, timed, stated is None)
    if check is not None and check.blurred and not check.wxyz and clock.offset is None and clock.words:
        raise RecordingError(
            f"{recording.path}: {clock.words}; its poses blur walls of {1e3 * check.expected:.0f} mm to "
            f"{1e3 * check.thickness:.0f} mm"
        )
    order = "xyzw (by default)" if stated is None else f"{stated} (by {'flag' if reading.quaternion else 'header'})"
    if check is not None and check.wxyz:
        poses, order = reorder(given), "wxyz (detected: as xyzw they blur the walls)"
        print(f"quaternions of {given.source}: {order}", flush=True)
        clock, timed = settle(recording, poses, auto)
        check = check_poses(recording, timed, False)
    facts = {**_GIVEN, "quaternions": order, **clock.facts, **({} if check is None else check.facts)}
    return Located(timed if clock.corrected else poses, facts, estimated=False)


def check_located(recording: Recording, located: Located) -> Located:
    """Return poses with what they make of the walls among their facts: rails hide where they blur them.

    Another cause is not named where a clock is off.
    """
    check = check_poses(recording, located.trajectory, False)
    if check is None:
        return located
    check = replace(check, cause="two clocks differ") if located.facts["clock_doubt"] else check
    return replace(located, facts={**located.facts, **check.facts})
