"""Wall polylines cut into short blocks, each in a thin box, so that a ray need only meet the few blocks near its hit.

Everything here runs once, on the host, in float64. Nothing is simplified: a block keeps every segment of its piece of
wall, and its box encloses them.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from subterra_jax.tunnel.boxes import LIDAR_GAP as LIDAR_GAP
from subterra_jax.tunnel.boxes import lidded, thin_boxes
from subterra_jax.tunnel.plan import Lining, TunnelPlan, Wall

# Where padding is, m, and half the thickness of its boxes: less than nothing, or a beam exactly towards them would
# enter them and take them for the nearest.
PADDING_CENTRE, PADDING_THICKNESS = 1e6, -1.0


@dataclasses.dataclass(frozen=True)
class Blocks:
    """Blocks of wall, in order of station.

    Attributes:
        centre: Middle of each box, m, `(n_blocks, 2)`; exactly representable in float32.
        half: Half the long axis of each box as a vector, m, `(n_blocks, 2)`.
        thickness: Half the thickness of each box, m, `(n_blocks,)`.
        offset: Vertices of each block from the middle of its box, m, `(n_blocks, m, 2)`; padded with the last one.
        station: Station of the middle of each block, m, `(n_blocks,)`.
    """

    centre: np.ndarray
    half: np.ndarray
    thickness: np.ndarray
    offset: np.ndarray
    station: np.ndarray


@dataclasses.dataclass(frozen=True)
class _Pieces:
    """Pieces of polylines, each a run of vertices of one long list.

    Attributes:
        vertex: All vertices, m.
        first: First vertex of each piece.
        last: Last vertex of each piece.
        station: Station of the middle of each, m.
        inward: -1 for a left wall, +1 for a right wall, 0 for furniture.
    """

    vertex: Float[np.ndarray, "v 2"]
    first: Int[np.ndarray, " n"]
    last: Int[np.ndarray, " n"]
    station: Float[np.ndarray, " n"]
    inward: Float[np.ndarray, " n"]


def _joined(parts: list[_Pieces]) -> _Pieces:
    """Pieces of several polylines in order of station."""
    shift = np.cumsum([0, *(len(part.vertex) for part in parts)])
    station = np.concatenate([part.station for part in parts])
    order = np.argsort(station, kind="stable")
    return _Pieces(
        vertex=np.concatenate([part.vertex for part in parts]),
        first=np.concatenate([p.first + s for p, s in zip(parts, shift, strict=False)])[order],
        last=np.concatenate([p.last + s for p, s in zip(parts, shift, strict=False)])[order],
        station=station[order],
        inward=np.concatenate([part.inward for part in parts])[order],
    )


def _wall_pieces(plan: TunnelPlan, wall: Wall, inward: float, length: float, max_segments: int) -> _Pieces:
    """One wall cut into pieces."""
    off_x, off_y = (wall.vertex[:, i] - np.interp(wall.station, plan.station, plan.centre[:, i]) for i in range(2))
    cuts = np.array(_cuts(wall.station, np.sqrt(off_x * off_x + off_y * off_y), length, max_segments))
    first, last = cuts[:-1], cuts[1:]
    middle = 0.5 * (wall.station[first] + wall.station[last])
    return _Pieces(wall.vertex, first, last, middle, np.full(len(first), inward))


def _cuts(
    station: Float[np.ndarray, " v"], clearance: Float[np.ndarray, " v"], length: float, max_segments: int
) -> list[int]:
    """The vertices between which the blocks of one wall lie.

    A block ends at the innermost vertex of the last part of its allowed length: never in a recess, whose mouth would
    then lie slanted in two thick boxes.
    """
    end = len(station) - 1
    furthest = np.searchsorted(station, station + length + 1e-9, side="right") - 1
    at = np.arange(len(station))
    furthest = np.minimum(np.maximum(furthest, at + 1), at + max_segments)
    within = np.minimum(furthest, end)
    earliest = np.searchsorted(station, station + 0.65 * (station[within] - station))
    earliest = np.minimum(np.maximum(earliest, at + 1), within)
    cuts = [0]
    while cuts[-1] < end:
        low, high = earliest[cuts[-1]], furthest[cuts[-1]]
        cuts.append(end if high >= end else int(low + np.argmin(clearance[low : high + 1])))
    return cuts


def _furniture_pieces(plan: TunnelPlan, furniture: Float[np.ndarray, "f 4"], max_segments: int) -> _Pieces:
    """Loose segments joined, where the next begins at the end of the last, into polylines of a few segments."""
    follows = np.all(np.abs(furniture[1:, :2] - furniture[:-1, 2:]) <= 1e-9, axis=1).tolist()
    begins, segments = [0], 1
    for i, joined in enumerate(follows, start=1):
        segments = segments + 1 if joined and segments < max_segments else 1
        if segments == 1:
            begins.append(i)
    begin = np.array(begins)
    count = np.diff(begin, append=len(furniture))
    # The vertices of a run: the start of each of its segments, and the end of the last.
    first = begin + np.arange(len(begin))
    last = first + count
    vertex = np.empty((len(furniture) + len(begin), 2))
    vertex[last] = furniture[begin + count - 1, 2:]
    vertex[np.setdiff1d(np.arange(len(vertex)), last, assume_unique=True)] = furniture[:, :2]
    mean = np.add.reduceat(vertex, first) / (count + 1)[:, None]
    nearest = [int(np.argmin((plan.centre[:, 0] - x) ** 2 + (plan.centre[:, 1] - y) ** 2)) for x, y in mean]
    return _Pieces(vertex, first, last, plan.station[nearest], np.zeros(len(first)))


def build_blocks(plan: TunnelPlan, lining: Lining, length: float, max_segments: int) -> Blocks:
    """Cut one lining into blocks.

    Args:
        plan: The tunnel, for its centreline.
        lining: The walls and furniture to cut.
        length: Wanted length of a block, m. A single longer wall segment stays whole.
        max_segments: Most segments in one block.
    """
    parts = [
        _wall_pieces(plan, lining.left, -1.0, length, max_segments),
        _wall_pieces(plan, lining.right, 1.0, length, max_segments),
    ]
    if len(lining.furniture):
        parts.append(_furniture_pieces(plan, lining.furniture, max_segments))
    pieces = _joined(parts)
    count = pieces.last - pieces.first + 1
    place = np.minimum(pieces.first[:, None] + np.arange(count.max()), pieces.last[:, None])
    vertex = pieces.vertex[place]
    centre, half, thickness = thin_boxes(*lidded(vertex, count, pieces.inward))
    return Blocks(centre, half, thickness, offset=vertex - centre[:, None, :], station=pieces.station)


def padded(blocks: Blocks, count: int) -> Blocks:
    """At least `count` blocks: the missing ones are points too far away to be seen, in boxes that nothing enters."""
    missing = max(0, count - len(blocks.centre))
    return Blocks(
        centre=np.pad(blocks.centre, ((0, missing), (0, 0)), constant_values=PADDING_CENTRE),
        half=np.pad(blocks.half, ((0, missing), (0, 0))),
        thickness=np.pad(blocks.thickness, (0, missing), constant_values=PADDING_THICKNESS),
        offset=np.pad(blocks.offset, ((0, missing), (0, 0), (0, 0))),
        station=np.pad(blocks.station, (0, missing), constant_values=np.inf),
    )
