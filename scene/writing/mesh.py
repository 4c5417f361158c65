"""Bore to triangles: the watertight air volume, the open lining, and the lining in chunks."""

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from manifold3d import Manifold, Mesh64, OpType

from scene.bore import Bore
from scene.errors import FitError
from scene.writing.recess import on_wall, recess_boxes, wall_normals
from scene.writing.unrolled import AROUND, Sheet, Unrolled, corners, triangulate, unroll

_MOUTH_TOLERANCE = 1e-4


def build_solid(bore: Bore, pockets: bool) -> Manifold:
    """The air of the bore as one solid, closed at both mouths, its triangles about 0.2 m in size.

    Args:
        bore: The bore.
        pockets: Whether the recesses of the lining are part of the air.

    Raises:
        FitError: The sections fold into each other, so that no solid comes out.
    """
    _require_unfolded(bore)
    plane = unroll(bore)
    boxes, apart = _boxes(bore, plane) if pockets else (np.empty((0, 4)), np.zeros(len(bore.pocket), bool))
    sheet = triangulate(plane, bore.length, np.sort(plane.to_around(corners(bore))), boxes[apart] if pockets else boxes)
    solid = Manifold(Mesh64(*_closed(bore, plane, sheet, np.flatnonzero(apart))))
    if solid.is_empty():
        raise FitError(f"the sections do not make a solid ({solid.status().name})")
    crowded = np.flatnonzero(~apart) if pockets else np.empty(0, np.intp)
    if len(crowded):
        recesses = [Manifold.hull_points(box) for box in recess_boxes(bore, crowded)]
        solid = solid + Manifold.batch_boolean(recesses, OpType.Add)
    return max(solid.decompose(), key=lambda part: part.volume())


def as_trimesh(solid: Manifold) -> trimesh.Trimesh:
    """The solid's triangles, normals out of the air."""
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(mesh.vert_properties[:, :3], mesh.tri_verts, process=False)


def open_lining(solid: trimesh.Trimesh, bore: Bore) -> trimesh.Trimesh:
    """The solid's surface without its two mouths, normals towards the axis, from which it is seen."""
    ends = ((bore.position[0], bore.tangent[0]), (bore.position[-1], bore.tangent[-1]))
    keep = np.ones(len(solid.faces), bool)
    for origin, normal in ends:
        flush = np.abs((solid.vertices - origin) @ normal) < _MOUTH_TOLERANCE
        near = np.linalg.norm(solid.vertices - origin, axis=1) < 2 * bore.radius.max()
        keep &= ~(flush & near)[solid.faces].all(axis=1)
    lining = trimesh.Trimesh(solid.vertices, solid.faces[keep][:, ::-1], process=False)
    lining.remove_unreferenced_vertices()
    return lining


def chunks(lining: trimesh.Trimesh, bore: Bore, length: float) -> list[trimesh.Trimesh]:
    """The lining cut at triangle borders into stretches of about `length` m."""
    station = bore.axis.local(lining.triangles_center)[0]
    index = np.clip(station // length, 0, max(int(bore.length / length) - 1, 0)).astype(np.intp)
    parts = [
        trimesh.Trimesh(lining.vertices, lining.faces[index == k], process=False) for k in range(int(index.max()) + 1)
    ]
    for part in parts:
        part.remove_unreferenced_vertices()
    return [part for part in parts if len(part.faces)]


def _require_unfolded(bore: Bore) -> None:
    step = np.einsum("nmi,ni->nm", np.diff(bore.surface(), axis=0), bore.tangent[:-1] + bore.tangent[1:])
    folded = np.flatnonzero((step <= 0).any(axis=1))
    if len(folded):
        raise FitError(
            f"the sections fold into each other at {bore.station[folded[0]]:.1f} m; "
            "is the curve too tight for the width?"
        )


def _boxes(bore: Bore, plane: Unrolled) -> tuple[Float[np.ndarray, "p 4"], Bool[np.ndarray, " p"]]:
    """Each pocket's rectangle in the plane, and whether it stands clear of the others, the seam and the mouths."""
    pocket, clear = bore.pocket, 0.6 * AROUND
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


def _closed(
    bore: Bore, plane: Unrolled, sheet: Sheet, pocket: Int[np.ndarray, " r"]
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """The sheet rolled up, its recesses pushed outwards, both mouths closed."""
    vertex = on_wall(bore, sheet.station, plane.to_angle(sheet.around))
    count, faces = len(vertex), sheet.faces
    rim = np.flatnonzero(sheet.rim)
    sunk = np.arange(count)
    sunk[rim] = count + np.arange(len(rim))
    push = np.zeros((count, 3))
    if len(pocket):
        outward = wall_normals(bore, pocket) * bore.pocket["depth"][pocket, None]
        push = np.where(sheet.recess[:, None] >= 0, outward[sheet.recess], 0.0)
    vertex = np.concatenate([np.where(sheet.rim[:, None], vertex, vertex + push), vertex[rim] + push[rim]])
    owner = sheet.recess[faces]
    inside = (owner[:, 0] >= 0) & (owner == owner[:, :1]).all(axis=1)
    faces = np.where(inside[:, None], sunk[faces], faces)
    first = np.flatnonzero(np.diff(sheet.recess[rim], prepend=-1))
    following = rim + 1
    following[np.append(first, len(rim))[1:] - 1] = rim[first]
    sides = [np.column_stack([rim, following, sunk[following]]), np.column_stack([rim, sunk[following], sunk[rim]])]
    return _capped(bore, sheet, vertex, np.concatenate([faces, *sides]))


def _capped(
    bore: Bore, sheet: Sheet, vertex: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """The mouths closed with fans about the axis."""
    caps, n = [], len(vertex)
    for k, station in enumerate((0.0, sheet.station.max())):
        ring = np.flatnonzero((sheet.station == station) & ~sheet.rim)
        ring = ring[np.argsort(sheet.around[ring])]
        after = np.roll(ring, -1)
        caps.append(np.column_stack([np.full(len(ring), n + k), *((after, ring) if k == 0 else (ring, after))]))
    vertex = np.concatenate([vertex, bore.position[[0, -1]]])
    return np.ascontiguousarray(vertex), np.ascontiguousarray(np.concatenate([faces, *caps]).astype(np.uint64))
