"""Where the LiDAR was: as given, or from odometry alone; `controlled` has the way by control."""

from scene.cli import Stages
from scene.poses.attitude import find_inertial, gyro_guide, levelling
from scene.poses.calibration import Calibration
from scene.poses.located import Located, track
from scene.poses.tracker import LIBRARY
from scene.poses.trajectory import Trajectory
from scene.reading.recording import Recording
from scene.resume import Partial


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


def by_odometry(recording: Recording, calibration: Calibration, progress: Stages, partial: Partial) -> Located:
    """LiDAR odometry, helped by the gyro where there is an IMU.

    Raises:
        FitError: Too few scans.
    """
    inertial, mount = find_inertial(recording, calibration)
    guide = gyro_guide(inertial, mount) if inertial and mount else None
    trajectory = track(recording, guide, progress, partial).trajectory
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
