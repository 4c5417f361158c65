"""What a tunnel file alone lets one draw: its walls at LiDAR height, pulled up from the ground."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from subterra_jax.tunnel.plan import TunnelPlan, Wall
from subterra_jax.viewer.course import Course

Colour = tuple[int, int, int]
_WALL, _FLOOR, _FURNITURE = (176, 172, 164), (112, 108, 102), (96, 120, 134)
WALL_HEIGHT = 2.6  # m; the file holds one height only, so this is for looks


@dataclasses.dataclass(frozen=True)
class Shape:
    """A surface of one colour.

    Attributes:
        name: What it is.
        vertices: Tunnel frame, m.
        faces: Rows of `vertices`, counter-clockwise as seen from within the tunnel.
        colour: Red, green, blue, 0 to 255.
        flat: Shade each face by its own normal.
        group: `lining` or `track`: what is shown and hidden together.
    """

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    colour: Colour
    flat: bool = True
    group: str = "lining"


def planar_shapes(plan: TunnelPlan, lining: str) -> list[Shape]:
    """Both walls, the floor and the furniture of one lining.

    Raises:
        TunnelError: The tunnel has no such lining.
    """
    course, walls = Course(plan), plan.lining(lining)
    shapes = [
        _ribbon("left", course, walls.left, _WALL, inward=False),
        _ribbon("right", course, walls.right, _WALL, inward=True),
        _floor(course),
    ]
    return [*shapes, _furniture(course, walls.furniture)] if len(walls.furniture) else shapes


def _ribbon(name: str, course: Course, wall: Wall, colour: Colour, *, inward: bool) -> Shape:
    """A wall from the ground up; `inward` says that its faces turn to the left of growing station."""
    foot = course.lifted(wall.vertex, wall.station, 0.0)
    n = len(foot)
    low = np.arange(n - 1)
    faces = np.concatenate([np.stack([low, low + 1, low + n], 1), np.stack([low + 1, low + n + 1, low + n], 1)])
    vertices = np.concatenate([foot, foot + np.array([0.0, 0.0, WALL_HEIGHT])])
    return Shape(name, vertices, faces[:, ::-1] if inward else faces, colour)


def _floor(course: Course) -> Shape:
    """The ground between the smooth walls."""
    plan = course.plan
    left, right = (course.place(plan.station, side * plan.half_width) for side in (1.0, -1.0))
    n = len(left)
    low = np.arange(n - 1)
    faces = np.concatenate([np.stack([low, low + n, low + 1], 1), np.stack([low + 1, low + n, low + n + 1], 1)])
    return Shape("floor", np.concatenate([left, right]), faces, _FLOOR, flat=False)


def _furniture(course: Course, segments: Float[np.ndarray, "f 4"]) -> Shape:
    """Posts, brackets and doors as upright panels seen from both sides."""
    ends = segments.reshape(-1, 2)
    _, nearest = KDTree(course.plan.centre).query(segments[:, :2])
    foot = course.lifted(ends, np.repeat(course.plan.station[nearest], 2), 0.0)
    vertices = np.concatenate([foot, foot + np.array([0.0, 0.0, WALL_HEIGHT])])
    first, n = 2 * np.arange(len(segments)), len(foot)
    front = np.concatenate(
        [np.stack([first, first + 1, first + n], 1), np.stack([first + 1, first + n + 1, first + n], 1)]
    )
    return Shape("furniture", vertices, np.concatenate([front, front[:, ::-1]]), _FURNITURE)
