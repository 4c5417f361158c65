"""A plain picture of a robot in its tunnel, drawn with NumPy: no display, no GL."""

import numpy as np

from subterra_jax.tunnel import Tunnel

BACKGROUND = (250, 250, 248)
WALL = (60, 60, 66)
BEAM = (240, 190, 120)
ROBOT = (30, 110, 200)


def wall_points(tunnel: Tunnel, step: float = 0.04) -> np.ndarray:
    """Points along every wall segment, at most `step` metres apart, `(n, 2)`, m."""
    vertex = np.asarray(tunnel.box)[:2].T[:, :, None] + np.asarray(tunnel.wall)
    start, end = (part.transpose(0, 2, 1).reshape(-1, 2) for part in (vertex[:, :, :-1], vertex[:, :, 1:]))
    return _along(start, end, step)


def _along(start: np.ndarray, end: np.ndarray, step: float) -> np.ndarray:
    """Points at most `step` apart along segments, both ends included."""
    count = np.maximum(1, np.ceil(np.linalg.norm(end - start, axis=1) / step)).astype(int) + 1
    owner = np.repeat(np.arange(len(start)), count)
    place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    share = (place / (count[owner] - 1))[:, None]
    return start[owner] + share * (end[owner] - start[owner])


def top_down(
    walls: np.ndarray,
    position: np.ndarray,
    heading: float,
    radius: float,
    ranges: np.ndarray,
    view: float = 24.0,
    size: int = 480,
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
    # Twice, half a pixel apart, so that walls are two pixels wide.
    for shift in (0.0, 0.6 / scale):
        paint(walls + shift, WALL)
    across = np.arange(-radius, radius, 0.5 / scale)
    disc = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)
    paint(position + disc[np.sum(disc**2, axis=1) <= radius**2], ROBOT)
    nose = np.linspace(0.0, 2.0 * radius, 40)[:, None] * np.array([np.cos(heading), np.sin(heading)])
    paint(position + nose, ROBOT)
    return picture
