"""A plain picture of a robot in its tunnel, drawn with NumPy: no display, no GL."""

from collections.abc import Sequence

import numpy as np

from subterra_jax.parts.part import Boxes
from subterra_jax.tunnel import Tunnel

BACKGROUND = (250, 250, 248)
WALL = (60, 60, 66)
BEAM = (240, 190, 120)
ROBOT = (30, 110, 200)
GOAL = (40, 160, 90)
BOX = (150, 90, 60)


def wall_points(tunnel: Tunnel, first: int, step: float = 0.04) -> np.ndarray:
    """Points along the walls that a LiDAR can see.

    Args:
        first: First block of the window, an entry of `tunnel.scan_first`.
        step: Largest distance between points, m.

    Returns:
        Points, m, `(n, 2)`.
    """
    window = slice(first, first + tunnel.n_scan)
    vertex = np.asarray(tunnel.box[:2, window]).T[:, :, None] + np.asarray(tunnel.wall[window])
    start, end = (part.transpose(0, 2, 1).reshape(-1, 2) for part in (vertex[:, :, :-1], vertex[:, :, 1:]))
    return _along(start, end, step)


def _along(start: np.ndarray, end: np.ndarray, step: float) -> np.ndarray:
    """Points at most `step` apart along segments, both ends included."""
    count = np.maximum(1, np.ceil(np.linalg.norm(end - start, axis=1) / step)).astype(int) + 1
    owner = np.repeat(np.arange(len(start)), count)
    place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    fraction = (place / (count[owner] - 1))[:, None]
    return start[owner] + fraction * (end[owner] - start[owner])


def _filled(boxes: Sequence[Boxes], position: np.ndarray, view: float, step: float) -> np.ndarray:
    points = [np.zeros((0, 2))]
    for centre, axis, half in (side for of in boxes for side in zip(of.centre, of.axis, of.half, strict=True)):
        if np.abs(centre - position).max() < view:
            along, across = (np.arange(-side, side, step) for side in half)
            u, v = (part.reshape(-1, 1) for part in np.meshgrid(along, across))
            points.append(centre + u * axis + v * np.array([-axis[1], axis[0]]))
    return np.concatenate(points)


def top_down(
    walls: np.ndarray,
    position: np.ndarray,
    heading: float,
    radius: float,
    ranges: np.ndarray,
    view: float = 24.0,
    size: int = 480,
    goal: np.ndarray | None = None,
    boxes: Sequence[Boxes] = (),
) -> np.ndarray:
    """The robot from above, in the middle of the picture, x to the right and y up.

    Args:
        walls: Points on the walls, m, `(n, 2)`.
        position: Position of the robot, m.
        heading: Its heading, rad.
        radius: Its radius, m.
        ranges: Its LiDAR ranges, m, beam 0 straight ahead, counter-clockwise.
        view: Width of what is seen, m.
        size: Width and height of the picture, pixels.
        goal: Both ends of a line across the tunnel, m, `(2, 2)`; None or empty for no goal.
        boxes: Boxes that stand in the way.

    Returns:
        Picture `(size, size, 3)`, uint8.
    """
    picture = np.full((size, size, 3), BACKGROUND, np.uint8)
    scale = size / view

    def paint(points: np.ndarray, colour: tuple[int, int, int]) -> None:
        column = np.floor((points[:, 0] - position[0]) * scale + size / 2).astype(int)
        row = np.floor(size / 2 - (points[:, 1] - position[1]) * scale).astype(int)
        seen = (column >= 0) & (column < size) & (row >= 0) & (row < size)
        picture[row[seen], column[seen]] = colour

    angle = heading + np.arange(len(ranges)) * (2.0 * np.pi / len(ranges))
    tips = position + ranges[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    paint(_along(np.broadcast_to(position, tips.shape), tips, 1.0 / scale), BEAM)
    if goal is not None and len(goal):
        for shift in (0.0, 1.0 / scale):
            paint(_along(goal[:1] + shift, goal[1:] + shift, 0.5 / scale), GOAL)
    if boxes:
        paint(_filled(boxes, position, view, 0.5 / scale), BOX)
    # Twice, half a pixel apart, so that walls are two pixels wide.
    for shift in (0.0, 0.6 / scale):
        paint(walls + shift, WALL)
    across = np.arange(-radius, radius, 0.5 / scale)
    disc = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)
    paint(position + disc[np.sum(disc**2, axis=1) <= radius**2], ROBOT)
    nose = np.linspace(0.0, 2.0 * radius, 40)[:, None] * np.array([np.cos(heading), np.sin(heading)])
    paint(position + nose, ROBOT)
    return picture
