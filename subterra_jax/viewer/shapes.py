"""Walls, floor and furniture of a tunnel, pulled up from its plan, and its track; plain arrays."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from subterra_jax.pictures.surfaces import Surface, track_surfaces
from subterra_jax.tunnel.plan import TunnelPlan, Wall

Colour = tuple[int, int, int]  # red, green, blue, 0 to 255
WALL_HEIGHT = 2.6  # m, for looks: a plan holds the walls at one height
_UNDER_RECESSES = 0.5  # m of floor beyond the walls
_BALLAST = 0.12  # m that floor and walls are drawn lower where a track lies, or they hide its sleepers in canted bends
_WALL, _FLOOR, _FURNITURE = (176, 172, 164), (112, 108, 102), (96, 120, 134)


@dataclasses.dataclass(frozen=True)
class Centreline:
    """A tunnel's centreline and its ground in three dimensions."""

    plan: TunnelPlan

    def points_at(self, station: Float[np.ndarray, "n"], lateral: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """Return points on the ground, m, `lateral` metres left of the centreline; straight on beyond the mouths."""
        plan = self.plan
        centre, tangent = (
            np.stack([np.interp(station, plan.station, values[:, i]) for i in range(2)], axis=-1)
            for values in (plan.centre, plan.tangent)
        )
        tangent = tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)
        centre = centre + (station - np.clip(station, 0.0, plan.length))[:, None] * tangent
        return self.lift(centre + lateral[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1), station)

    def lift(self, points: Float[np.ndarray, "n 2"], station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """Add the height of the ground at their stations to plan positions, m; level beyond the mouths."""
        return np.column_stack([points, np.interp(station, self.plan.station, self.plan.elevation)])


@dataclasses.dataclass(frozen=True)
class Shape:
    """A surface of one colour."""

    name: str
    vertices: Float[np.ndarray, "v 3"]  # tunnel frame, m
    faces: Int[np.ndarray, "f 3"]  # rows of `vertices`, counter-clockwise as seen from within the tunnel
    colour: Colour


def planar_shapes(plan: TunnelPlan, lining: str) -> list[Shape]:
    """Return both walls, the floor and the furniture of one lining; rails and sleepers where the plan has a shell.

    Raises:
        TunnelError: The tunnel does not have the lining.
    """
    centreline, walls = Centreline(plan), plan.lining(lining)
    shapes = [
        _ribbon("left", centreline, walls.left, inward=False),
        _ribbon("right", centreline, walls.right, inward=True),
        _floor(centreline),
    ]
    if plan.shell is not None and len(plan.shell.track):
        for shape in shapes:
            shape.vertices[:, 2] -= _BALLAST
        shapes += [_track(surface) for surface in track_surfaces(plan.shell)]
    return [*shapes, _furniture(centreline, walls.furniture)] if len(walls.furniture) else shapes


def _track(surface: Surface) -> Shape:
    red, green, blue = (round(255 * part) for part in surface.colour)
    return Shape(surface.name, surface.triangles.vertices, surface.triangles.faces, (red, green, blue))


def _ribbon(name: str, centreline: Centreline, wall: Wall, *, inward: bool) -> Shape:
    """Return a wall from the ground up; with `inward` its faces look to the left of growing station."""
    faces = _strip(len(wall.vertex))
    return Shape(name, _raised(centreline.lift(wall.vertex, wall.station)), faces[:, ::-1] if inward else faces, _WALL)


def _floor(centreline: Centreline) -> Shape:
    plan = centreline.plan
    half = plan.half_width + _UNDER_RECESSES
    left, right = (centreline.points_at(plan.station, side * half) for side in (1.0, -1.0))
    return Shape("floor", np.concatenate([left, right]), _strip(len(left))[:, ::-1], _FLOOR)


def _furniture(centreline: Centreline, segments: Float[np.ndarray, "f 4"]) -> Shape:
    """Return posts, brackets and doors as upright panels, visible from both sides."""
    _, nearest = KDTree(centreline.plan.centre).query(segments[:, :2])
    foot = centreline.lift(segments.reshape(-1, 2), np.repeat(centreline.plan.station[nearest], 2))
    front = _strip(len(foot)).reshape(2, -1, 3)[:, ::2].reshape(-1, 3)  # every other piece: a panel stands alone
    return Shape("furniture", _raised(foot), np.concatenate([front, front[:, ::-1]]), _FURNITURE)


def _raised(foot: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    return np.concatenate([foot, foot + np.array([0.0, 0.0, WALL_HEIGHT])])


def _strip(n: int) -> Int[np.ndarray, "f 3"]:
    """Return the faces between a line of `n` vertices and the line of the next `n`."""
    low = np.arange(n - 1)
    return np.concatenate([np.stack([low, low + 1, low + n], 1), np.stack([low + 1, low + n + 1, low + n], 1)])
