"""Triangles of the lining with its pockets, and of the floor."""

import numpy as np
from jaxtyping import Float, Int

from scene.survey.alignment import Alignment
from scene.survey.furniture import POCKET_LENGTH, POCKET_OFFSET, Furniture
from scene.survey.mesh import Mesh, Part, join
from scene.survey.section import Section
from scene.survey.shape import CELL, refine

_JOINT_HALF = 0.01  # m: the strip that is darker than the lining around a ring joint
_FLOOR_CELL = 0.3  # m across the floor


def station_rows(furniture: Furniture, length: float) -> Float[np.ndarray, "n"]:
    """Stations of the surface grid: mouths, ring joints, the edges and middle of every pocket, and cells between."""
    half = 0.5 * POCKET_LENGTH
    offsets = np.array([0.0, _JOINT_HALF, *(POCKET_OFFSET + half * np.array([-1, 0, 1]))])
    near = (furniture.joints[furniture.pocketed, None] + np.concatenate([-offsets, offsets])).ravel()
    bare = (furniture.joints[~furniture.pocketed, None] + _JOINT_HALF * np.array([-1, 0, 1])).ravel()
    breaks = np.concatenate([[0.0, length], near, bare])
    return refine(breaks[(breaks >= 0.0) & (breaks <= length)], CELL)


def _quads(index: Int[np.ndarray, "n m"]) -> Int[np.ndarray, "n-1 m-1 4"]:
    """Corners of the cells of a grid of vertices."""
    return np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1)


def _split(quads: Int[np.ndarray, "*q 4"]) -> Int[np.ndarray, "t 3"]:
    """Two triangles of each quad, turned so that the normals of a grid (station, girth) point into the bore."""
    quads = quads.reshape(-1, 4)
    return np.stack([quads[:, [2, 1, 0]], quads[:, [3, 2, 0]]], axis=1).reshape(-1, 3)


def surface_mesh(alignment: Alignment, section: Section, furniture: Furniture) -> Mesh:
    """Lining, pockets and floor, with normals towards the air; both mouths open."""
    rows = station_rows(furniture, alignment.length)
    frames, shape = alignment.frames(rows), section.shape
    nodes = section.rough(rows)
    vertices = frames.point(nodes[..., 0], nodes[..., 1])
    n, m = nodes.shape[:2]
    index = np.arange(n * m).reshape(n, m)
    quads = _quads(index)

    part = np.full(quads.shape[:2], Part.LINING, np.uint8)
    middle = 0.5 * (rows[1:] + rows[:-1])
    part[np.min(abs(middle[:, None] - furniture.joints), axis=1, initial=np.inf) < _JOINT_HALF] = Part.JOINT
    keep = np.ones(quads.shape[:2], bool)
    pockets = []
    for j, r, side in np.argwhere(furniture.pocketed[:, None, None] & ~furniture.filled):
        centre = furniture.joints[j] + (2 * side - 1) * POCKET_OFFSET
        i0, ic, i1 = np.searchsorted(rows, centre + 0.5 * POCKET_LENGTH * np.array([-1, 0, 1]) - 1e-6)
        j0, jc, j1 = shape.rows[r]
        keep[i0:i1, j0:j1] = False
        out = shape.normal[jc, 0] * frames.lateral[ic] + shape.normal[jc, 1] * frames.up[ic]
        pockets.append(_pocket(vertices[i0 : i1 + 1, j0 : j1 + 1], furniture.depth[j, r, side] * out, rows[ic]))

    station = np.broadcast_to(middle[:, None], keep.shape)
    lining = Mesh(vertices.reshape(-1, 3), _split(quads[keep]), part[keep].repeat(2), station[keep].repeat(2))
    return join([lining, *pockets, _floor(vertices[:, 0], vertices[:, -1], rows)])


def _pocket(mouth: Float[np.ndarray, "a b 3"], out: Float[np.ndarray, "3"], station: float) -> Mesh:
    """A recess: the surface of its mouth moved by `out`, and sides parallel to `out`."""
    a, b = mouth.shape[:2]
    index = np.arange(a * b).reshape(a, b)
    rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    ahead = np.roll(rim, -1)
    sides = np.stack([rim, ahead, ahead + a * b, rim + a * b], axis=-1)
    faces = np.concatenate([_split(_quads(index)) + a * b, _split(sides)])
    vertices = np.concatenate([mouth.reshape(-1, 3), mouth.reshape(-1, 3) + out])
    return Mesh(vertices, faces, np.full(len(faces), Part.POCKET, np.uint8), np.full(len(faces), station))


def _floor(left: Float[np.ndarray, "n 3"], right: Float[np.ndarray, "n 3"], rows: Float[np.ndarray, "n"]) -> Mesh:
    """The floor, straight from the foot of the right wall to that of the left."""
    n_across = int(np.ceil(np.linalg.norm(left - right, axis=1).max() / _FLOOR_CELL)) + 1
    share = np.linspace(0.0, 1.0, n_across)[:, None]
    vertices = right[:, None] + share * (left - right)[:, None]
    faces = _split(_quads(np.arange(len(rows) * n_across).reshape(len(rows), n_across)))
    station = (0.5 * (rows[1:] + rows[:-1])).repeat(2 * (n_across - 1))
    return Mesh(vertices.reshape(-1, 3), faces, np.full(len(faces), Part.FLOOR, np.uint8), station)
