"""Poses from the scans themselves, by LiDAR odometry (GenZ-ICP).

In a bore the scans barely constrain the motion along the axis: attitude and cross-axis position come out well, the
length does not. The manifest says so.
"""

from collections.abc import Callable

import numpy as np
from genz_icp.config import GenZConfig
from genz_icp.genz_icp import GenZICP
from scipy.spatial.transform import Rotation

from scene.errors import FitError
from scene.recording import Recording
from scene.trajectory import Trajectory

LIBRARY = "genz-icp"
_MIN_POINTS = 100
_LEVEL_DURATION = 0.2  # s; short, since a carrier sways


def estimate_trajectory(recording: Recording, advance: Callable[[], None] = lambda: None) -> Trajectory:
    """One pose per scan, in the first scan's sensor frame turned so that z is up (by the IMU, where there is one).

    Args:
        recording: The recording; each scan is read once.
        advance: Called after each scan, for a progress bar.

    Raises:
        FitError: Fewer than two usable scans.
    """
    odometry = GenZICP(_config())
    times, poses = [], []
    for scan in recording.scans():
        advance()
        if len(scan.points) < _MIN_POINTS:
            continue
        span = max(scan.times[-1], 1e-9)
        odometry.register_frame(scan.points.astype(np.float64), scan.times / span)
        times.append(scan.stamp + 0.5 * span)  # GenZ-ICP deskews to the middle of the sweep
        poses.append(odometry.last_pose.copy())
    if len(poses) < 2:
        raise FitError(f"{recording.path}: only {len(poses)} scans hold {_MIN_POINTS} points; too few for odometry")
    stack = np.asarray(poses)
    level = _levelling(recording.up_at_start(_LEVEL_DURATION))
    return Trajectory(
        np.asarray(times), level.apply(stack[:, :3, 3]), level * Rotation.from_matrix(stack[:, :3, :3]), LIBRARY
    )


def _levelling(up: np.ndarray | None) -> Rotation:
    """The smallest turn that makes `up` vertical."""
    if up is None:
        return Rotation.identity()
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0]


def _config() -> GenZConfig:
    config = GenZConfig()
    config.data.deskew = True
    config.data.max_range = 60.0
    return config
