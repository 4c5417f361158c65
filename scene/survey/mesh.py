"""Triangles of the true bore: lining with pockets, floor, nails, sleepers, rails, pads and clips."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float, Int, UInt8

from scene.survey import furniture as fur
from scene.survey.alignment import Alignment
from scene.survey.furniture import Furniture
from scene.survey.section import CELL, Section, refine_breaks


class Part(IntEnum):
    """Part of the bore that a triangle belongs to; the values stand in `truth.ply` as `part`."""

    LINING = 0
    JOINT = 1
    POCKET = 2
    NAIL = 3
    FLOOR = 4
    SLEEPER = 5
    RAIL = 6
    FASTENING = 7
    THING = 8


@dataclass(frozen=True)
class Mesh:
    """Triangles with normals towards the air."""

    vertices: Float[np.ndarray, "v 3"]  # Survey frame, m
    faces: Int[np.ndarray, "f 3"]  # Vertices of each triangle, anticlockwise seen from the air
    part: UInt8[np.ndarray, "f"]  # `Part` of each triangle
    station: Float[np.ndarray, "f"]  # Station of each triangle, good to about a metre, m


def join_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Return one mesh of all triangles; vertices are not merged."""
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=True)]),
        np.concatenate([m.part for m in meshes]),
        np.concatenate([m.station for m in meshes]),
    )


EMPTY = Mesh(np.empty((0, 3)), np.empty((0, 3), int), np.empty(0, np.uint8), np.empty(0))

# Corners of a box of half-size one (along, lateral, up) and its twelve triangles, normals outwards.
_CORNERS = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
_BOX = np.array([
    (0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4),
    (2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2), (1, 3, 7), (1, 7, 5),
])  # fmt: skip
_NAIL_SIDES = 16
_BURIED = 0.005  # m
_RAIL_STEP = 0.25  # m; the chord of a 150 m bend is then off by 0.05 mm


def _copy_shape(
    shape: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    centre: Float[np.ndarray, "k 3"],
    axes: Float[np.ndarray, "k 3 3"],
    part: Part,
    station: Float[np.ndarray, "k"],
) -> Mesh:
    vertices = centre[:, None] + np.einsum("kij,vj->kvi", axes, shape)
    every = faces + len(shape) * np.arange(len(centre))[:, None, None]
    parts = np.full(len(centre) * len(faces), part, np.uint8)
    return Mesh(vertices.reshape(-1, 3), every.reshape(-1, 3), parts, station.repeat(len(faces)))


def track_mesh(alignment: Alignment, section: Section, furniture: Furniture) -> Mesh:
    """Return sleepers, rails, pads and clips; each sleeper lies in the section of its own station."""
    if not furniture.tracks:
        return EMPTY
    return join_meshes([_one_track(alignment, section, furniture, offset) for offset in furniture.tracks])


def _one_track(alignment: Alignment, section: Section, furniture: Furniture, offset: float) -> Mesh:
    """Return a track whose middle runs `offset` m to the left of the axis."""
    s, rise, sizes = furniture.sleepers, furniture.rise, furniture.sizes
    pad = (*fur.PAD, sizes.pad)
    frames = alignment.frames(s)
    floor = -0.5 * section.height(s)

    def boxes(shape: np.ndarray, across: float, above: float, part: Part) -> Mesh:
        return _copy_shape(
            shape, _BOX, frames.point(np.full_like(s, offset + across), floor + above), frames.matrix, part, s
        )

    # Down to just under the floor only: from outside the mouth, one would see the buried part beneath it.
    tall = rise + _BURIED + 0.5 * sizes.sleeper_length * abs(section.crossfall)
    low = sizes.sleeper_top + (fur.SLEEPER_BOTTOM - sizes.sleeper_top) * tall / fur.SLEEPER_HEIGHT
    sleeper = 0.5 * _CORNERS * (1.0, sizes.sleeper_length, tall)
    sleeper[:, 0] *= np.where(sleeper[:, 2] > 0, sizes.sleeper_top, low)
    meshes = [boxes(sleeper, 0.0, rise - 0.5 * tall, Part.SLEEPER)]
    for rail in (furniture.rail_axis, -furniture.rail_axis):
        meshes.append(boxes(0.5 * _CORNERS * pad, rail, rise + 0.5 * sizes.pad, Part.FASTENING))
        for side in (-1, 1):
            across = rail + side * (fur.CLIP_INNER + 0.5 * fur.CLIP[1])
            above = rise + 0.5 * fur.CLIP[2]
            meshes.append(boxes(0.5 * _CORNERS * fur.CLIP, across, above, Part.FASTENING))
        meshes.append(_rail_mesh(alignment, section, furniture, offset + rail))
    return join_meshes(meshes)


def _rail_mesh(alignment: Alignment, section: Section, furniture: Furniture, across: float) -> Mesh:
    """One rail from mouth to mouth, `across` to the left of the axis, on sleepers that rise above the floor."""
    stations = np.linspace(0.0, alignment.length, int(np.ceil(alignment.length / _RAIL_STEP)) + 1)
    half = furniture.rail_half
    # Half at negative `lateral` upwards, the middle of the head, the other half downwards: normals come out outwards.
    outline = np.concatenate([half * (-1, 1), [(0.0, furniture.rail_height)], half[::-1]])
    k, n = len(outline), len(stations)
    base = furniture.rise + furniture.sizes.pad - 0.5 * section.height(stations)[:, None]
    y, z = np.broadcast_to(outline[:, 0] + across, (n, k)), outline[:, 1] + base
    vertices = alignment.frames(stations).point(y, z).reshape(-1, 3)

    ring = np.arange(k)
    ahead = np.roll(ring, -1)
    wall = np.concatenate([np.stack([ring, ring + k, ahead], 1), np.stack([ahead, ring + k, ahead + k], 1)])
    walls = (wall + k * np.arange(n - 1)[:, None, None]).reshape(-1, 3)
    # The outline is symmetric, so strips between its halves close the ends.
    low = np.arange(k // 2)
    cap = np.concatenate([np.stack([low, low + 1, k - 1 - low], 1), np.stack([low + 1, k - 2 - low, k - 1 - low], 1)])
    cap = cap[(cap[:, 0] != cap[:, 1]) & (cap[:, 1] != cap[:, 2])]
    faces = np.concatenate([walls, cap, cap[:, ::-1] + k * (n - 1)])
    step = np.concatenate([stations[:-1].repeat(len(wall)), np.zeros(len(cap)), np.full(len(cap), alignment.length)])
    return Mesh(vertices, faces, np.full(len(faces), Part.RAIL, np.uint8), step)


def nail_mesh(alignment: Alignment, section: Section, furniture: Furniture) -> Mesh:
    """Return cylinders between the middles of two pockets, behind the lining except in the pockets."""
    joint, row = np.nonzero(furniture.nails)
    station = furniture.joints[joint]
    node = section.shape.rows[row, 1]
    ends = []
    for offset in (-furniture.sizes.pocket_offset, furniture.sizes.pocket_offset):
        frames = alignment.frames(station + offset)
        at = np.arange(len(node))
        yz = section.rough(station + offset)[at, node] + fur.NAIL_DEPTH * section.shape.normal[node]
        ends.append(frames.point(yz[:, 0], yz[:, 1]))
    along = ends[1] - ends[0]
    half = 0.5 * np.linalg.norm(along, axis=1)
    x = 0.5 * along / half[:, None]
    up = alignment.frames(station).up
    y = np.cross(up, x)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    axes = np.stack([x * half[:, None], y, np.cross(x, y)], axis=-1)

    n = _NAIL_SIDES
    turn = 2.0 * np.pi * np.arange(n) / n
    circle = 0.5 * fur.NAIL_DIAMETER * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    rings = [np.column_stack([np.full(n, side), circle]) for side in (-1.0, 1.0)]
    ring = np.arange(n)
    ahead = np.roll(ring, -1)
    fan = np.stack([np.zeros(n - 2, int), ring[1:-1], ring[2:]], 1)
    faces = np.concatenate([
        np.stack([ring, ring + n, ahead], 1)[:, ::-1], np.stack([ahead, ring + n, ahead + n], 1)[:, ::-1],
        fan[:, ::-1], fan + n,
    ])  # fmt: skip
    return _copy_shape(np.concatenate(rings), faces, 0.5 * (ends[0] + ends[1]), axes, Part.NAIL, station)


_JOINT_HALF = 0.01  # m: the strip that is darker than the lining around a ring joint
_FLOOR_CELL = 0.3  # m across the floor


def station_rows(furniture: Furniture, length: float) -> Float[np.ndarray, "n"]:
    """Return the stations of the surface grid: mouths, joints, edges and middles of pockets, and cells between."""
    half, offset = 0.5 * furniture.sizes.pocket_length, furniture.sizes.pocket_offset
    offsets = np.array([0.0, _JOINT_HALF, *(offset + half * np.array([-1, 0, 1]))])
    near = (furniture.joints[furniture.pocketed, None] + np.concatenate([-offsets, offsets])).ravel()
    bare = (furniture.joints[~furniture.pocketed, None] + _JOINT_HALF * np.array([-1, 0, 1])).ravel()
    breaks = np.concatenate([[0.0, length], near, bare])
    return refine_breaks(breaks[(breaks >= 0.0) & (breaks <= length)], CELL)


def grid_quads(index: Int[np.ndarray, "n m"]) -> Int[np.ndarray, "n-1 m-1 4"]:
    """Corners of the cells of a grid of vertices."""
    return np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1)


def split_quads(quads: Int[np.ndarray, "*q 4"]) -> Int[np.ndarray, "t 3"]:
    """Two triangles of each quad, turned so that the normals of a grid (station, girth) point into the bore."""
    quads = quads.reshape(-1, 4)
    return np.stack([quads[:, [2, 1, 0]], quads[:, [3, 2, 0]]], axis=1).reshape(-1, 3)


def surface_mesh(alignment: Alignment, section: Section, furniture: Furniture) -> Mesh:
    """Return lining, pockets and floor, with normals towards the air; both mouths are open."""
    rows = station_rows(furniture, alignment.length)
    frames, shape = alignment.frames(rows), section.shape
    nodes = section.rough(rows)
    vertices = frames.point(nodes[..., 0], nodes[..., 1])
    n, m = nodes.shape[:2]
    index = np.arange(n * m).reshape(n, m)
    quads = grid_quads(index)

    part = np.full(quads.shape[:2], Part.LINING, np.uint8)
    middle = 0.5 * (rows[1:] + rows[:-1])
    part[np.min(abs(middle[:, None] - furniture.joints), axis=1, initial=np.inf) < _JOINT_HALF] = Part.JOINT
    keep = np.ones(quads.shape[:2], bool)
    pockets, sizes = [], furniture.sizes
    for j, r, side in np.argwhere(furniture.pocketed[:, None, None] & ~furniture.filled):
        centre = furniture.joints[j] + (2 * side - 1) * sizes.pocket_offset
        i0, ic, i1 = np.searchsorted(rows, centre + 0.5 * sizes.pocket_length * np.array([-1, 0, 1]) - 1e-6)
        j0, jc, j1 = shape.rows[r]
        keep[i0:i1, j0:j1] = False
        out = shape.normal[jc, 0] * frames.lateral[ic] + shape.normal[jc, 1] * frames.up[ic]
        pockets.append(pocket_mesh(vertices[i0 : i1 + 1, j0 : j1 + 1], furniture.depth[j, r, side] * out, rows[ic]))

    station = np.broadcast_to(middle[:, None], keep.shape)
    lining = Mesh(vertices.reshape(-1, 3), split_quads(quads[keep]), part[keep].repeat(2), station[keep].repeat(2))
    return join_meshes([lining, *pockets, _floor_mesh(vertices[:, 0], vertices[:, -1], rows)])


def pocket_mesh(mouth: Float[np.ndarray, "a b 3"], out: Float[np.ndarray, "3"], station: float) -> Mesh:
    """Return a recess: the surface of its mouth moved by `out`, and sides parallel to `out`."""
    a, b = mouth.shape[:2]
    index = np.arange(a * b).reshape(a, b)
    rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    ahead = np.roll(rim, -1)
    sides = np.stack([rim, ahead, ahead + a * b, rim + a * b], axis=-1)
    faces = np.concatenate([split_quads(grid_quads(index)) + a * b, split_quads(sides)])
    vertices = np.concatenate([mouth.reshape(-1, 3), mouth.reshape(-1, 3) + out])
    return Mesh(vertices, faces, np.full(len(faces), Part.POCKET, np.uint8), np.full(len(faces), station))


def _floor_mesh(left: Float[np.ndarray, "n 3"], right: Float[np.ndarray, "n 3"], rows: Float[np.ndarray, "n"]) -> Mesh:
    n_across = int(np.ceil(np.linalg.norm(left - right, axis=1).max() / _FLOOR_CELL)) + 1
    fraction = np.linspace(0.0, 1.0, n_across)[:, None]
    vertices = right[:, None] + fraction * (left - right)[:, None]
    faces = split_quads(grid_quads(np.arange(len(rows) * n_across).reshape(len(rows), n_across)))
    station = (0.5 * (rows[1:] + rows[:-1])).repeat(2 * (n_across - 1))
    return Mesh(vertices.reshape(-1, 3), faces, np.full(len(faces), Part.FLOOR, np.uint8), station)
