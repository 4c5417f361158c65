"""Where the LiDAR was: from position control, IMU and odometry together, or from odometry alone."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.progress import Progress
from scipy.spatial.transform import Rotation

from scene.errors import RecordingError
from scene.poses.attitude import find_inertial, gyro_guide, levelling
from scene.poses.calibration import Calibration, Mount
from scene.poses.chain import Chain
from scene.poses.control import MIN_SHARE, Control
from scene.poses.imu import Inertial
from scene.poses.odometry import LIBRARY, Guide, Odometry, estimate_odometry
from scene.poses.problem import Noise, Problem, solve_with_heading
from scene.poses.smoother import inertial_problem, odometry_problem, steps_of_imu
from scene.poses.trajectory import Trajectory
from scene.reading.recording import Recording

# Guides: what is trusted of the turn (rad) and the shift (m) from one sweep to the next.
_BY_CONTROL = (np.deg2rad(0.1), 0.02)
_BY_CONTROL_WITHOUT_IMU = (np.deg2rad(0.5), 0.02)
_OUTLIER = 4.0  # standard deviations
_END = 0.05  # m; an end of the bore is found to this, on simulated surveys


@dataclass(frozen=True)
class Located:
    """Where the LiDAR was, and what the manifest says of it.

    Attributes:
        trajectory: Poses of the LiDAR; in the control's frame where there was one, else level from the first sweep.
        estimated: Whether the poses were found here, so that they are worth writing down.
        most_uncovered: Share of the scans that may lie outside the trajectory's time.
        facts: `poses`, `length_fixed_by`, `length_uncertainty` (m, 95 %, or `None` where nobody can say) and figures.
    """

    trajectory: Trajectory
    facts: dict[str, Any]
    estimated: bool = True
    most_uncovered: float = 0.05


def given(trajectory: Trajectory) -> Located:
    """Poses as they were given; how well they fix the length is for their maker to say."""
    return Located(
        trajectory,
        {
            "poses": "given trajectory",
            "length_fixed_by": "given trajectory",
            "length_uncertainty": None,
            "length_uncertainty_from": "not stated: the trajectory came without one",
        },
        estimated=False,
    )


def by_odometry(recording: Recording, calibration: Calibration, progress: Progress) -> Located:
    """LiDAR odometry, helped by the gyro where there is an IMU.

    Raises:
        FitError: Too few scans.
    """
    inertial, mount = find_inertial(recording, calibration)
    guide = gyro_guide(inertial, mount) if inertial and mount else None
    trajectory = _odometry(recording, guide, progress).trajectory
    level = levelling(recording, trajectory, inertial, mount)
    poses = Trajectory(trajectory.times, level.apply(trajectory.positions), level * trajectory.rotations, LIBRARY)
    facts = {
        "poses": LIBRARY,
        "imu": inertial.topic if inertial else None,
        "length_fixed_by": f"odometry ({LIBRARY}); nothing measured the axial scale",
        "length_uncertainty": None,
        "length_uncertainty_from": "unknown: nobody measured the axial scale",
    }
    return Located(poses, facts)


def by_control(recording: Recording, control: Control, calibration: Calibration, progress: Progress) -> Located:
    """All that was measured, in the control's frame.

    Raises:
        RecordingError: The control does not overlap the recording.
        FitError: Too few scans, or what was measured does not determine the trajectory.
    """
    start, end = _span(recording)
    control.require_overlap(start, end, recording.path)
    inertial, mount = find_inertial(recording, calibration)
    if inertial and mount:
        problem, chain = _with_imu(recording, inertial, mount, control, calibration, progress)
        trajectory = _lidar_poses(chain, mount)
    else:
        problem, chain = _without_imu(recording, control, calibration, progress)
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
    progress: Progress,
) -> tuple[Problem, Chain]:
    lever = mount.rotation @ calibration.prism + mount.shift
    problem, chain = inertial_problem(inertial, control, lever, Noise())
    chain = solve_with_heading(problem, chain)
    odometry = _odometry(recording, Guide(_lidar_poses(chain, mount), True, *_BY_CONTROL), progress)
    problem = replace(problem, steps=steps_of_imu(odometry, chain, mount))
    return problem, problem.solve(chain)[0]


def _without_imu(
    recording: Recording, control: Control, calibration: Calibration, progress: Progress
) -> tuple[Problem, Chain]:
    """Twice: the first smoothing guides the second odometry, which then slips and smears less."""
    guide = None
    for _ in range(2):
        problem, chain = odometry_problem(_odometry(recording, guide, progress), control, calibration.prism, Noise())
        chain = solve_with_heading(problem, chain)
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


def _odometry(recording: Recording, guide: Guide | None, progress: Progress) -> Odometry:
    task = progress.add_task("LiDAR odometry", total=recording.scan_count)
    return estimate_odometry(recording, guide, lambda: progress.advance(task))


def _span(recording: Recording) -> tuple[float, float]:
    """Times of the first and the last scan, s, without reading the scans where the file knows them."""
    times = [scan.stamp for scan in recording.scans()]
    if len(times) < 2:
        raise RecordingError(f"{recording.path}: holds {len(times)} scans; at least 2 are needed")
    return times[0], times[-1]
