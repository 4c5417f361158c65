"""From the bore to triangles: the watertight air volume, the open lining, and the parts in which it is drawn."""

from typing import cast

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from manifold3d import Manifold, Mesh64, OpType

from scene.bore import Bore
from scene.errors import FitError, Refusal
from scene.fitting.assemble import find_fold
from scene.writing import unrolled
from scene.writing.unrolled import Sheet, Unrolled

_MOUTH_TOLERANCE = 1e-4  # m from the plane of a mouth


def build_solid(bore: Bore, pockets: bool) -> Manifold:
    """Builds the air of the bore as one solid, closed at both mouths, of triangles of about 0.2 m.

    With `pockets`, the recesses of the lining are part of the air. Raises `FitError` where sections fold into each
    other.
    """
    if (fold := find_fold(bore)) is not None:
        why = f"the sections fold into each other at {fold:.1f} m; is the curve too tight for the width?"
        raise FitError(why, Refusal.FOLDED)
    plane = unrolled.unroll_section(bore)
    boxes, apart = _pocket_rectangles(bore, plane) if pockets else (np.empty((0, 4)), np.zeros(len(bore.pocket), bool))
    sheet = unrolled.triangulate(
        plane, bore.length, np.sort(plane.to_around(unrolled.section_corners(bore))), boxes[apart] if pockets else boxes
    )
    solid = Manifold(Mesh64(*_close_sheet(bore, plane, sheet, np.flatnonzero(apart))))
    if solid.is_empty():
        raise FitError(f"the sections do not make a solid ({solid.status().name})", Refusal.FOLDED)
    crowded = np.flatnonzero(~apart) if pockets else np.empty(0, np.intp)
    if len(crowded):
        recesses = [Manifold.hull_points(box) for box in unrolled.recess_boxes(bore, crowded)]
        solid = solid + Manifold.batch_boolean(recesses, OpType.Add)
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
    ends = ((bore.position[0], bore.tangent[0]), (bore.position[-1], bore.tangent[-1]))
    keep = np.ones(len(solid.faces), bool)
    for origin, normal in ends:
        flush = np.abs((solid.vertices - origin) @ normal) < _MOUTH_TOLERANCE
        near = np.linalg.norm(solid.vertices - origin, axis=1) < 2 * bore.radius.max()
        keep &= ~(flush & near)[solid.faces].all(axis=1)
    lining = trimesh.Trimesh(solid.vertices, solid.faces[keep][:, ::-1], process=False)
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


def _pocket_rectangles(bore: Bore, plane: Unrolled) -> tuple[Float[np.ndarray, "p 4"], Bool[np.ndarray, " p"]]:
    """Each pocket's rectangle in the plane, and whether it is clear of other pockets, the seam and the mouths."""
    pocket, clear = bore.pocket, 0.6 * unrolled.AROUND
    u, half = plane.to_around(pocket["angle"]), pocket["width"] / 2
    box = np.column_stack([u - half, u + half, pocket["station"] - pocket["length"] / 2, pocket["station"]])
    box[:, 3] += pocket["length"] / 2
    apart = (box[:, 0] > clear) & (box[:, 1] < plane.girth - clear)
    apart &= (box[:, 2] > clear) & (box[:, 3] < bore.length - clear)
    order = np.argsort(box[:, 2], kind="stable")
    longest = np.max(box[:, 3] - box[:, 2], initial=0.0)
    for place, k in enumerate(order):
        last = np.searchsorted(box[order, 2], box[k, 3] + clear) if longest else place
        others = order[place + 1 : last]
        near = (box[others, 0] < box[k, 1] + clear) & (box[others, 1] > box[k, 0] - clear)
        apart[others[near]] = False
    return box, apart


def _close_sheet(
    bore: Bore, plane: Unrolled, sheet: Sheet, pocket: Int[np.ndarray, " r"]
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Return the sheet rolled up, its recesses pushed outwards, both mouths closed."""
    vertex = unrolled.wall_points(bore, sheet.station, plane.to_angle(sheet.around))
    count, faces = len(vertex), sheet.faces
    rim = np.flatnonzero(sheet.rim)
    sunk = np.arange(count)
    sunk[rim] = count + np.arange(len(rim))
    push = np.zeros((count, 3))
    if len(pocket):
        outward = unrolled.wall_normals(bore, pocket) * bore.pocket["depth"][pocket, None]
        push = np.where(sheet.recess[:, None] >= 0, outward[sheet.recess], 0.0)
    vertex = np.concatenate([np.where(sheet.rim[:, None], vertex, vertex + push), vertex[rim] + push[rim]])
    owner = sheet.recess[faces]
    inside = (owner[:, 0] >= 0) & (owner == owner[:, :1]).all(axis=1)
    faces = np.where(inside[:, None], sunk[faces], faces)
    first = np.flatnonzero(np.diff(sheet.recess[rim], prepend=-1))
    following = rim + 1
    following[np.append(first, len(rim))[1:] - 1] = rim[first]
    sides = [np.column_stack([rim, following, sunk[following]]), np.column_stack([rim, sunk[following], sunk[rim]])]
    return _cap_mouths(bore, sheet, vertex, np.concatenate([faces, *sides]))


def _cap_mouths(
    bore: Bore, sheet: Sheet, vertex: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    caps, n = [], len(vertex)
    for k, station in enumerate((0.0, sheet.station.max())):
        ring = np.flatnonzero((sheet.station == station) & ~sheet.rim)
        ring = ring[np.argsort(sheet.around[ring])]
        after = np.roll(ring, -1)
        caps.append(np.column_stack([np.full(len(ring), n + k), *((after, ring) if k == 0 else (ring, after))]))
    vertex = np.concatenate([vertex, bore.position[[0, -1]]])
    return np.ascontiguousarray(vertex), np.ascontiguousarray(np.concatenate([faces, *caps]).astype(np.uint64))


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
    depth = np.linalg.norm(chunk.vertices - unrolled.wall_points(bore, station, angle), axis=1)
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
    plane = unrolled.unroll_section(bore)
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
