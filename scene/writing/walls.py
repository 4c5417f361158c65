"""What bodies collide with where the lining is: patches all around, and a few panels at robots' height."""

from xml.etree import ElementTree as ET

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from shapely import LineString, Point

from scene.bore import Bore
from scene.writing.markup import LOW_WALL, SOLID, along, box
from scene.writing.panels import Opening, wall_panels
from scene.writing.planar import Walls
from scene.writing.track import Track

_TOLERANCE = 0.02
_HEIGHT = 2.5
_DEPTH = 0.3  # below the top of the sleepers
_THICKNESS = 0.10


def add_patches(world: ET.Element, bore: Bore, track: Track, openings: list[Opening]) -> int:
    """Invisible boxes behind the whole lining; returns how many."""
    panels = wall_panels(bore, track.bed, openings)
    for k, panel in enumerate(panels):
        box(world, f"wall_{k:05d}", panel.half, panel.centre, panel.rotation, SOLID, group="3")
    return len(panels)


def add_low_panels(world: ET.Element, walls: Walls, bore: Bore, track: Track, niches: list[tuple[float, float]]) -> int:
    """Invisible upright boxes behind both walls at robots' height, within 2 cm of the wall's polyline.

    `niches` of the left wall, as first and last station in m, are left open.
    """
    count = 0
    for side, name, wall, station in (
        (1, "left", walls.left, walls.left_station),
        (-1, "right", walls.right, walls.right_station),
    ):
        line = LineString(wall)
        kept = np.asarray(line.simplify(_TOLERANCE).coords)
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(wall, axis=0), axis=1))])
        kept_station = np.interp([line.project(Point(vertex)) for vertex in kept], arc, station)
        gaps = niches if side == 1 else []
        cut = np.array([end for gap in gaps for end in gap])
        on_line = [line.interpolate(float(at)) for at in np.interp(cut, station, arc)]
        order = np.argsort(np.append(kept_station, cut), kind="stable")
        kept = np.concatenate([kept, np.array([(at.x, at.y) for at in on_line]).reshape(-1, 2)])[order]
        kept_station = np.append(kept_station, cut)[order]
        middle_height = np.interp(kept_station, bore.station, track.elevation) + _HEIGHT / 2 - _DEPTH
        ends = np.column_stack([kept, middle_height])
        for k in range(len(ends) - 1):
            if any(first <= kept_station[k : k + 2].mean() <= last for first, last in gaps):
                continue
            rotation = along(ends[k], ends[k + 1])
            middle = (ends[k] + ends[k + 1]) / 2 + rotation.apply([0, side * _THICKNESS / 2, 0])
            size = np.array([np.linalg.norm(ends[k + 1] - ends[k]) / 2 + 0.01, _THICKNESS / 2, _HEIGHT / 2])
            box(world, f"low_wall_{name}_{k:03d}", size, middle, rotation, LOW_WALL, group="3")
            count += 1
    return count


def add_niche(world: ET.Element, name: str, corners: Float[np.ndarray, "8 3"]) -> None:
    """Boxes behind the five sides of a niche.

    Args:
        world: Where they go.
        name: First part of their names.
        corners: Of the niche: bit 2 of a corner's number along the bore, bit 1 around it, bit 0 into the wall.
    """
    grid = corners.reshape(2, 2, 2, 3)
    edges = [grid[1, 0, 0] - grid[0, 0, 0], grid[0, 1, 0] - grid[0, 0, 0], grid[0, 0, 1] - grid[0, 0, 0]]
    half = np.array([np.linalg.norm(edge) for edge in edges]) / 2
    frame = np.stack([edge / np.linalg.norm(edge) for edge in edges], axis=1)
    turned = frame * [1.0, np.sign(np.linalg.det(frame)), 1.0]
    centre, thin = corners.mean(axis=0), _THICKNESS / 2
    for side, (axis, sign) in {
        "back": (2, 1),
        "near": (0, -1),
        "far": (0, 1),
        "below": (1, -1),
        "above": (1, 1),
    }.items():
        size = np.where(np.arange(3) == axis, thin, half)
        middle = centre + sign * (half[axis] + thin) * frame[:, axis]
        box(world, f"{name}_{side}", size, middle, Rotation.from_matrix(turned), SOLID | LOW_WALL, group="3")
