"""Where each browser looks from."""

import numpy as np
import viser
from jaxtyping import Float

from subterra_jax.viewer.course import Course
from subterra_jax.viewer.frames import Frame

CHASE, ABOVE, MAP, FREE = MODES = ("chase", "from above", "map", "free")
_FOV = np.deg2rad(60.0)


def pose(
    mode: str, course: Course, frame: Frame | None
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None:
    """Place of the camera and the point it looks at, m; None where it is left alone.

    Args:
        mode: One of `MODES`.
        course: The tunnel.
        frame: The moment; None before there is an episode, which is the start of the tunnel.
    """
    if mode == FREE:
        return None
    if mode == MAP:
        return _map(course)
    position, facing = _robot(course, frame)
    up = np.array([0.0, 0.0, 1.0])
    if mode == CHASE:
        return position - 3.6 * facing + 1.9 * up, position + 3.0 * facing + 0.7 * up
    left = np.cross(up, facing)
    return position - 8.0 * facing - 5.0 * left + 9.0 * up, position + 2.0 * facing


def place(client: viser.ClientHandle, at: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> None:
    """Puts one browser's camera somewhere; does nothing to a browser that said nonsense about its camera."""
    try:
        with client.atomic():
            client.camera.position = at
            client.camera.look_at = target
    except (TypeError, ValueError, AssertionError):
        return


def _robot(course: Course, frame: Frame | None) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Where the robot is and faces."""
    if frame is not None:
        return frame.position, np.array([np.cos(frame.heading), np.sin(frame.heading), 0.0])
    zero = np.zeros(1)
    return course.place(zero, zero)[0], np.array([*course.plan.tangent[0], 0.0])


def _map(course: Course) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Above the middle of the tunnel, high enough to see both ends, a little from the south so that north is up."""
    low, high = course.plan.centre.min(axis=0), course.plan.centre.max(axis=0)
    middle = np.array([*(0.5 * (low + high)), float(np.mean(course.plan.elevation))])
    height = 0.62 * max(high[0] - low[0], 1.6 * (high[1] - low[1]), 30.0) / np.tan(0.5 * _FOV)
    return middle + np.array([0.0, -0.15 * height, height]), middle
