"""Bore to triangles: the watertight air volume, the open lining, and the lining in chunks."""

import numpy as np
import trimesh
from jaxtyping import Float, Int
from manifold3d import Manifold, Mesh64, OpType

from scene.bore import Bore
from scene.errors import FitError

_SIMPLIFY = 0.002
_LID_OVERLAP = 0.05  # how far a recess reaches into the air, so that the union leaves no film
_MOUTH_TOLERANCE = 1e-4


def build_solid(bore: Bore, pockets: bool) -> Manifold:
    """The air of the bore as one solid, closed at both mouths, simplified to 2 mm.

    Args:
        bore: The bore.
        pockets: Whether the recesses of the lining are part of the air.

    Raises:
        FitError: The sections fold into each other, so that no solid comes out.
    """
    solid = Manifold(Mesh64(*_tube(bore.surface(), bore.position)))
    if solid.is_empty():
        raise FitError(
            f"the sections do not make a solid ({solid.status().name}); is the curve too tight for the width?"
        )
    solid = solid.simplify(_SIMPLIFY)
    if pockets and len(bore.pocket):
        recesses = Manifold.batch_boolean([Manifold.hull_points(box) for box in recess_boxes(bore)], OpType.Add)
        solid = solid + recesses
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


def recess_boxes(bore: Bore) -> list[Float[np.ndarray, "8 3"]]:
    """Corners of each pocket as a box square to the wall it is sunk into, m."""
    axis, boxes = bore.axis, []
    surface = bore.surface()
    for pocket in bore.pocket:
        row = int(np.argmin(np.abs(bore.station - pocket["station"])))
        at = axis.at(np.array([pocket["station"]]))
        radius = np.interp(pocket["angle"], bore.angle, bore.radius[row], period=2 * np.pi)
        lateral, up, tangent = at.lateral[0], at.up[0], at.tangent[0]
        centre = at.position[0] + radius * (np.cos(pocket["angle"]) * lateral + np.sin(pocket["angle"]) * up)
        outward = wall_normal(surface[row], bore, row, pocket["angle"])
        around = np.cross(outward, tangent)
        along = np.cross(around, outward)
        steps = [
            (0.5 * pocket["length"] * along, (-1, 1)),
            (0.5 * pocket["width"] * around, (-1, 1)),
        ]
        corners = [
            centre + i * steps[0][0] + j * steps[1][0] + d * outward
            for i in steps[0][1]
            for j in steps[1][1]
            for d in (-_LID_OVERLAP, float(pocket["depth"]))
        ]
        boxes.append(np.asarray(corners))
    return boxes


def wall_normal(section: Float[np.ndarray, "m 3"], bore: Bore, row: int, angle: float) -> Float[np.ndarray, "3"]:
    """Outward unit normal of a section's polygon at an angle, over an arc of about 5°."""
    m = len(bore.angle)
    column = int(np.argmin(np.abs(np.angle(np.exp(1j * (bore.angle - angle))))))
    reach = max(1, m // 144)
    chord = section[(column + reach) % m] - section[(column - reach) % m]
    normal = np.cross(chord, bore.tangent[row])
    return normal / np.linalg.norm(normal)


def _tube(
    surface: Float[np.ndarray, "n m 3"], centre: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    n, m, _ = surface.shape
    corner = np.arange(n * m).reshape(n, m)
    a, b = corner[:-1], np.roll(corner[:-1], -1, axis=1)
    c, d = corner[1:], np.roll(corner[1:], -1, axis=1)
    wall = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    first, last = n * m, n * m + 1
    mouths = [
        np.stack([np.full(m, first), np.roll(corner[0], -1), corner[0]], -1),
        np.stack([np.full(m, last), corner[-1], np.roll(corner[-1], -1)], -1),
    ]
    vertices = np.concatenate([surface.reshape(-1, 3), centre[[0]], centre[[-1]]])
    faces = np.concatenate([wall, *mouths]).astype(np.uint64)
    return np.ascontiguousarray(vertices), np.ascontiguousarray(faces)
