"""Surfaces of a tunnel: its plan's walls pulled up from the ground, or every part of a scene folder."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from subterra_jax.lidar3d.surface import LINING_KINDS, SCENES, ScenePart, joined, read_mesh, scene_parts
from subterra_jax.tunnel.plan import TunnelPlan, Wall
from subterra_jax.viewer.geometry import Centreline

Colour = tuple[int, int, int]
_WALL, _FLOOR, _FURNITURE = (176, 172, 164), (112, 108, 102), (96, 120, 134)
WALL_HEIGHT = 2.6  # m, for looks: the file holds one height only


@dataclasses.dataclass(frozen=True)
class Shape:
    """A surface of one colour.

    Attributes:
        name: Name of the surface.
        vertices: Vertices, tunnel frame, m.
        faces: Rows of `vertices`, counter-clockwise as seen from within the tunnel.
        colour: Red, green, blue, 0 to 255.
        flat: Shade each face by its own normal.
        group: `lining` or `track`; a group is shown and hidden as one.
    """

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    colour: Colour
    flat: bool = True
    group: str = "lining"


def planar_shapes(plan: TunnelPlan, lining: str) -> list[Shape]:
    """Return both walls, the floor and the furniture of one lining.

    Raises:
        TunnelError: The tunnel does not have the lining.
    """
    centreline, walls = Centreline(plan), plan.lining(lining)
    shapes = [
        _ribbon("left", centreline, walls.left, _WALL, inward=False),
        _ribbon("right", centreline, walls.right, _WALL, inward=True),
        _floor(centreline),
    ]
    return [*shapes, _furniture(centreline, walls.furniture)] if len(walls.furniture) else shapes


def _ribbon(name: str, centreline: Centreline, wall: Wall, colour: Colour, *, inward: bool) -> Shape:
    """Return a wall from the ground up; with `inward` its faces look to the left of growing station."""
    foot = centreline.lift(wall.vertex, wall.station, 0.0)
    n = len(foot)
    low = np.arange(n - 1)
    faces = np.concatenate([np.stack([low, low + 1, low + n], 1), np.stack([low + 1, low + n + 1, low + n], 1)])
    vertices = np.concatenate([foot, foot + np.array([0.0, 0.0, WALL_HEIGHT])])
    return Shape(name, vertices, faces[:, ::-1] if inward else faces, colour)


def _floor(centreline: Centreline) -> Shape:
    """Return the ground between the smooth walls."""
    plan = centreline.plan
    left, right = (centreline.points_at(plan.station, side * plan.half_width) for side in (1.0, -1.0))
    n = len(left)
    low = np.arange(n - 1)
    faces = np.concatenate([np.stack([low, low + n, low + 1], 1), np.stack([low + 1, low + n, low + n + 1], 1)])
    return Shape("floor", np.concatenate([left, right]), faces, _FLOOR, flat=False)


def _furniture(centreline: Centreline, segments: Float[np.ndarray, "f 4"]) -> Shape:
    """Return posts, brackets and doors as upright panels, visible from both sides."""
    ends = segments.reshape(-1, 2)
    _, nearest = KDTree(centreline.plan.centre).query(segments[:, :2])
    foot = centreline.lift(ends, np.repeat(centreline.plan.station[nearest], 2), 0.0)
    vertices = np.concatenate([foot, foot + np.array([0.0, 0.0, WALL_HEIGHT])])
    first, n = 2 * np.arange(len(segments)), len(foot)
    front = np.concatenate(
        [np.stack([first, first + 1, first + n], 1), np.stack([first + 1, first + n + 1, first + n], 1)]
    )
    return Shape("furniture", vertices, np.concatenate([front, front[:, ::-1]]), _FURNITURE)


_CONCRETE, _BALLAST = (178, 174, 166), (124, 118, 110)
_PAINT: dict[str, Colour] = {
    "concrete": _CONCRETE,
    "floor": _BALLAST,
    "ballast": _BALLAST,
}  # textured in the scene


def lining_shape(folder: Path, lining: str) -> Shape:
    """Return the whole lining as one surface; quick.

    Raises:
        TunnelError: The mesh is missing or damaged.
    """
    name = "lining_smooth.ply" if lining == "smooth" else "lining.ply"
    mesh = read_mesh(folder / "meshes" / name)
    return Shape("lining", mesh.vertices, mesh.faces, _CONCRETE, flat=False)


def scene_shapes(folder: Path, lining: str) -> list[Shape]:
    """Return everything that a camera sees in a scene, one shape for each material; takes seconds.

    For `smooth` it is the track alone, since the scene's walls have pockets.

    Raises:
        TunnelError: A file of the scene is missing or damaged.
    """
    groups: dict[tuple[str, str], list[ScenePart]] = {}
    for part in scene_parts(folder / SCENES[lining], LINING_KINDS if lining == "smooth" else ()):
        group = "lining" if part.kind in LINING_KINDS else "track"
        groups.setdefault((group, part.material), []).append(part)
    shapes = []
    for (group, material), parts in groups.items():
        surface = joined([part.triangles for part in parts])
        colour = _colour(parts[0])
        shapes.append(Shape(f"{group} {material}", surface.vertices, surface.faces, colour, group != "lining", group))
    return shapes


def _colour(part: ScenePart) -> Colour:
    """Return the material's own colour; for a textured one, about its texture's."""
    if part.material in _PAINT or not part.material:
        return _PAINT.get(part.material, _CONCRETE)
    red, green, blue = (round(255 * float(value)) for value in part.colour[:3])
    return red, green, blue
