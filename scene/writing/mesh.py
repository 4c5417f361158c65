"""From the bore to triangles: the watertight air volume, the open lining, and the parts in which it is drawn."""

from typing import cast

import numpy as np
import trimesh
from jaxtyping import Float
from manifold3d import Manifold, Mesh64, OpType

from scene.bore import Bore
from scene.errors import FitError, Refusal
from subterra_jax.host.unrolled import BAND, close_mouths, corners, open_mouths, rectangles, roll_up, triangulate

SPACING = (0.18, 0.2)  # of the triangulated wall's points, along and around, m


def build_solid(bore: Bore, pockets: bool) -> Manifold:
    """Builds the air of the bore as one solid, closed at both mouths, of triangles of about 0.2 m.

    With `pockets`, the recesses of the lining are part of the air. Raises `FitError` where sections fold into each
    other.
    """
    if (fold := bore.find_fold()) is not None:
        why = f"the sections fold into each other at {fold:.1f} m; is the curve too tight for the width?"
        raise FitError(why, Refusal.FOLDED)
    plane, wall = bore.unrolled(), bore.wall
    pocket = bore.recesses if pockets else np.empty((0, 5))
    boxes, apart = rectangles(plane, bore.length, pocket, BAND * SPACING[1])
    creases = np.sort(plane.to_around(corners(bore.angle, bore.radius.mean(axis=0))))
    sheet = triangulate(plane, bore.length, creases, boxes[apart], SPACING)
    vertex, faces = close_mouths(wall, sheet, *roll_up(wall, plane, sheet, pocket[apart]))
    solid = Manifold(Mesh64(np.ascontiguousarray(vertex), np.ascontiguousarray(faces.astype(np.uint64))))
    if solid.is_empty():
        raise FitError(f"the sections do not make a solid ({solid.status().name})", Refusal.FOLDED)
    if not apart.all():
        crowded = [Manifold.hull_points(box) for box in bore.recess_boxes(np.flatnonzero(~apart))]
        solid = solid + Manifold.batch_boolean(crowded, OpType.Add)
    return max(solid.decompose(), key=lambda part: part.volume())


def as_trimesh(solid: Manifold) -> trimesh.Trimesh:
    """Return the solid's triangles, normals out of the air."""
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(mesh.vert_properties[:, :3], mesh.tri_verts, process=False)


def join_meshes(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return one mesh of all triangles; vertices are not merged."""
    return cast(trimesh.Trimesh, trimesh.util.concatenate(meshes))


def open_lining(solid: trimesh.Trimesh, bore: Bore) -> trimesh.Trimesh:
    """Return the solid's surface without its two mouths, normals towards the axis, from which it is seen."""
    kept = open_mouths(bore.wall, solid.vertices, solid.faces)
    lining = trimesh.Trimesh(solid.vertices, kept[:, ::-1], process=False)
    lining.remove_unreferenced_vertices()
    return lining


def split_lining(lining: trimesh.Trimesh, bore: Bore, length: float) -> list[trimesh.Trimesh]:
    """Return the lining cut at triangle borders into stretches of about `length` m."""
    station = bore.axis.local(lining.triangles_center)[0]
    index = np.clip(station // length, 0, max(int(bore.length / length) - 1, 0)).astype(np.intp)
    parts = [
        trimesh.Trimesh(lining.vertices, lining.faces[index == k], process=False) for k in range(int(index.max()) + 1)
    ]
    for part in parts:
        part.remove_unreferenced_vertices()
    return [part for part in parts if len(part.faces)]


_FLOOR_HEIGHT = 0.15  # of the bed, m
_SEGMENT = (0.8, 2.5)  # lengths of segments, m
_SUNK = 0.03  # behind the smooth wall, m
_LEVEL = 0.8  # least upward part of a floor's normal
_BALLAST = 1.4  # side of the picture of the ballast, m
_BAY = 1.5  # length of half the picture of the concrete where there are no rings, m

Coordinates = tuple[Float[np.ndarray, "t 2"], np.ndarray]


def has_rings(bore: Bore) -> bool:
    """Return whether the rings are segments: evenly spaced, as far apart as segments are long."""
    if len(bore.ring_station) < 4:
        return False
    pitch = np.diff(bore.ring_station)
    usual = float(np.median(pitch))
    even = np.abs(pitch / usual - np.rint(pitch / usual)) < 0.1
    return bool(_SEGMENT[0] < usual < _SEGMENT[1] and even.mean() > 0.8)


def split_skin(
    chunk: trimesh.Trimesh, bore: Bore, bed: Float[np.ndarray, " n"]
) -> dict[str, tuple[trimesh.Trimesh, Coordinates | None]]:
    """Return a chunk's faces as `lining`, `recess` and `floor`, whichever there are.

    They share no vertices, so that the normals that a renderer smooths do not round off the rims of recesses, and
    within a recess no two faces do.
    """
    station, lateral, up = bore.axis.local(chunk.vertices)
    angle = np.arctan2(up, lateral)
    height = chunk.vertices[:, 2] - np.interp(station, bore.station, bed)
    low = (np.abs(height[chunk.faces]) < _FLOOR_HEIGHT).all(axis=1) & (chunk.face_normals[:, 2] > _LEVEL)
    depth = np.linalg.norm(chunk.vertices - bore.wall.points(station, angle), axis=1)
    sunk = (depth[chunk.faces] > _SUNK).any(axis=1) & ~low
    parts: dict[str, tuple[trimesh.Trimesh, Coordinates | None]] = {}
    for name, chosen in (("lining", ~low & ~sunk), ("recess", sunk), ("floor", low)):
        if not chosen.any():
            continue
        if name == "recess":
            flat = chunk.triangles[chosen].reshape(-1, 3)
            parts[name] = trimesh.Trimesh(flat, np.arange(len(flat)).reshape(-1, 3), process=False), None
            continue
        used, corner = np.unique(chunk.faces[chosen], return_inverse=True)
        corner = corner.reshape(-1, 3)
        mesh = trimesh.Trimesh(chunk.vertices[used], corner, process=False)
        if name == "floor":
            parts[name] = mesh, (np.column_stack([lateral[used], station[used]]) / _BALLAST, corner)
        else:
            parts[name] = mesh, _wall_texture(bore, station[used], angle[used], corner)
    return parts


def _wall_texture(bore: Bore, station: np.ndarray, angle: np.ndarray, corner: np.ndarray) -> Coordinates:
    """Texture coordinates: one picture a turn and two rings; faces across the seam go beyond one."""
    plane = bore.unrolled()
    u = plane.to_around(angle) / plane.girth
    v = _ring_number(bore, station) / 2
    wraps = np.ptp(u[corner], axis=1) > 0.5
    beyond = wraps[:, None] & (u[corner] < 0.5)
    texture = np.concatenate([np.column_stack([u, v]), np.column_stack([u + 1, v])])
    return texture, corner + len(u) * beyond


def _ring_number(bore: Bore, station: np.ndarray) -> np.ndarray:
    """Number of rings from the first joint, with fractions between joints."""
    joint = bore.ring_station
    if not has_rings(bore):
        return station / _BAY
    pitch = float(np.median(np.diff(joint)))
    number = np.rint((joint - joint[0]) / pitch)
    ends = np.array([joint[0] - 9 * pitch, *joint, joint[-1] + 9 * pitch])
    return np.interp(station, ends, [number[0] - 9, *number, number[-1] + 9])
