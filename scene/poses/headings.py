"""A first guess of the attitude: level from gravity or odometry, heading from the way the control moved."""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from scene.poses import rotation as so3

_LEVEL_TIME = 1.0  # s; over this a walker's accelerations cancel
_TRACK_TIME = 10.0  # s; over this the carrier faces, on average, the way it goes


def levelled(
    times: Float[np.ndarray, " n"], rate: Float[np.ndarray, "n 3"], force: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3 3"]:
    """Attitudes whose roll and pitch follow gravity and whose heading follows the gyro from zero.

    Args:
        times: Evenly spaced, s.
        rate: rad/s.
        force: Any unit.
    """
    step = float(np.median(np.diff(times)))
    up = gaussian_filter1d(force, _LEVEL_TIME / step, axis=0, mode="nearest")
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    heading = np.concatenate([[0.0], np.cumsum(np.einsum("ij,ij->i", rate, up)[:-1] * np.diff(times))])
    # The smallest turn from `up` to the vertical.
    axis = np.cross(up, [0.0, 0.0, 1.0])
    size = np.linalg.norm(axis, axis=1, keepdims=True)
    level = so3.exp(axis / np.maximum(size, 1e-9) * np.arctan2(size[:, 0], up[:, 2])[:, None])
    return _about_z(heading) @ level


def along_track(
    times: Float[np.ndarray, " n"], attitude: Float[np.ndarray, "n 3 3"], velocity: Float[np.ndarray, "n 3"], yaw: float
) -> Float[np.ndarray, "n 3 3"]:
    """The attitudes with a slow turn about the vertical, so that their x axis keeps `yaw` rad left of the motion.

    Args:
        times: Evenly spaced, s.
        attitude: Whose heading drifts slowly.
        velocity: In the fixed frame, m/s; weighs by its size.
        yaw: How the body is mounted.
    """
    step = float(np.median(np.diff(times)))
    facing = np.arctan2(attitude[:, 1, 0], attitude[:, 0, 0])
    pointer = (velocity[:, 0] + 1j * velocity[:, 1]) * np.exp(1j * (yaw - facing))
    width = min(_TRACK_TIME, 0.25 * (times[-1] - times[0])) / step
    smooth = gaussian_filter1d(pointer.real, width, mode="nearest") + 1j * gaussian_filter1d(
        pointer.imag, width, mode="nearest"
    )
    return _about_z(np.angle(smooth)) @ attitude


def _about_z(angle: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3 3"]:
    return so3.exp(angle[:, None] * np.array([0.0, 0.0, 1.0]))
