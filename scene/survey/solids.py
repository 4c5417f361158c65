"""Triangles of the solids in the bore: nails, sleepers, rails, pads and clips."""

import numpy as np
from jaxtyping import Float, Int

from scene.survey import furniture as fur
from scene.survey.alignment import Alignment
from scene.survey.furniture import Furniture
from scene.survey.mesh import Mesh, Part, join
from scene.survey.section import Section

# Corners of a box of half-size one (along, lateral, up) and its twelve triangles, normals outwards.
_CORNERS = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
_BOX = np.array([
    (0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4),
    (2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2), (1, 3, 7), (1, 7, 5),
])  # fmt: skip
_NAIL_SIDES = 16
_BURIED = 0.005  # m
_RAIL_STEP = 0.25  # m; the chord of a 150 m bend is then off by 0.05 mm


def _copies(
    shape: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    centre: Float[np.ndarray, "k 3"],
    axes: Float[np.ndarray, "k 3 3"],
    part: Part,
    station: Float[np.ndarray, "k"],
) -> Mesh:
    """One copy of a shape for each centre and frame."""
    vertices = centre[:, None] + np.einsum("kij,vj->kvi", axes, shape)
    every = faces + len(shape) * np.arange(len(centre))[:, None, None]
    parts = np.full(len(centre) * len(faces), part, np.uint8)
    return Mesh(vertices.reshape(-1, 3), every.reshape(-1, 3), parts, station.repeat(len(faces)))


def track_mesh(alignment: Alignment, section: Section, furniture: Furniture) -> Mesh:
    """Sleepers, rails, pads and clips. The track follows the floor, each sleeper in the section of its own station."""
    s = furniture.sleepers
    frames = alignment.frames(s)
    floor = -0.5 * section.height(s)

    def boxes(shape: np.ndarray, across: float, above: float, part: Part) -> Mesh:
        return _copies(shape, _BOX, frames.point(np.full_like(s, across), floor + above), frames.matrix, part, s)

    # Down to just under the floor only: from outside the mouth, one would see the buried part beneath it.
    tall = fur.SLEEPER_RISE + _BURIED + 0.5 * fur.SLEEPER_LENGTH * abs(section.crossfall)
    low = fur.SLEEPER_TOP + (fur.SLEEPER_BOTTOM - fur.SLEEPER_TOP) * tall / fur.SLEEPER_HEIGHT
    sleeper = 0.5 * _CORNERS * (1.0, fur.SLEEPER_LENGTH, tall)
    sleeper[:, 0] *= np.where(sleeper[:, 2] > 0, fur.SLEEPER_TOP, low)
    meshes = [boxes(sleeper, 0.0, fur.SLEEPER_RISE - 0.5 * tall, Part.SLEEPER)]
    for rail in (fur.RAIL_AXIS, -fur.RAIL_AXIS):
        meshes.append(boxes(0.5 * _CORNERS * fur.PAD, rail, fur.SLEEPER_RISE + 0.5 * fur.PAD[2], Part.FASTENING))
        for side in (-1, 1):
            across = rail + side * (fur.CLIP_INNER + 0.5 * fur.CLIP[1])
            above = fur.SLEEPER_RISE + 0.5 * fur.CLIP[2]
            meshes.append(boxes(0.5 * _CORNERS * fur.CLIP, across, above, Part.FASTENING))
        meshes.append(_rail(alignment, section, rail))
    return join(meshes)


def _rail(alignment: Alignment, section: Section, across: float) -> Mesh:
    """One rail from mouth to mouth, `across` to the left of the axis."""
    stations = np.linspace(0.0, alignment.length, int(np.ceil(alignment.length / _RAIL_STEP)) + 1)
    half = fur.RAIL_HALF
    # Half at negative `lateral` upwards, the middle of the head, the other half downwards: normals come out outwards.
    outline = np.concatenate([half * (-1, 1), [(0.0, fur.RAIL_HEIGHT)], half[::-1]])
    k, n = len(outline), len(stations)
    base = fur.SLEEPER_RISE + fur.PAD[2] - 0.5 * section.height(stations)[:, None]
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
    """Nails: cylinders between the middles of two pockets, behind the lining except where they cross the pockets."""
    joint, row = np.nonzero(furniture.nails)
    station = furniture.joints[joint]
    node = section.shape.rows[row, 1]
    ends = []
    for offset in (-fur.POCKET_OFFSET, fur.POCKET_OFFSET):
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
    return _copies(np.concatenate(rings), faces, 0.5 * (ends[0] + ends[1]), axes, Part.NAIL, station)
