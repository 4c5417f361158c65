"""Wall polylines cut into short blocks, each in a thin box, so that a ray need only meet the few blocks near its hit.

Everything here runs once, on the host, in float64. Nothing is simplified: a block keeps every segment of its piece of
wall, and its box encloses them.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from subterra_jax.plan import Lining, TunnelPlan, Wall

# Boxes are a little larger than their walls, so that rounding on the device cannot shut a wall out of its box: m.
BOX_MARGIN = 1e-5
# A robot never brings its LiDAR nearer to a wall than this: footprint radius less the motion of one step, m.
LIDAR_GAP = 0.2


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


def _cuts(wall: Wall, clearance: np.ndarray, length: float, max_segments: int) -> list[tuple[int, int]]:
    """First and last vertex of each block of one wall.

    A block ends at the innermost vertex of the last part of its allowed length: never in a recess, whose mouth would
    then lie slanted in two thick boxes.
    """
    station, cuts, first = wall.station, [], 0
    while first < len(station) - 1:
        furthest = int(np.searchsorted(station, station[first] + length + 1e-9, side="right")) - 1
        furthest = min(max(furthest, first + 1), first + max_segments)
        earliest = int(np.searchsorted(station, station[first] + 0.65 * (station[furthest] - station[first])))
        earliest = min(max(earliest, first + 1), furthest)
        last = earliest + int(np.argmin(clearance[earliest : furthest + 1]))
        if len(station) - 1 <= furthest:
            last = len(station) - 1
        cuts.append((first, last))
        first = last
    return cuts


def _lidded(vertex: np.ndarray, inward: float) -> np.ndarray:
    """The inner hull of a piece of wall: its pockets and hollows closed with lids.

    A beam from inside the tunnel can meet the piece only through this line, and what it meets behind a lid belongs to
    the same piece; so it is enough that the box encloses the line. That keeps boxes thin where pockets are deep.

    Args:
        vertex: Vertices in the direction of growing station, `(k, 2)`, m.
        inward: -1 for a left wall, whose inside is on its right; +1 for a right wall.

    Returns:
        Some of the vertices; all of them where a recess is deep.
    """
    hull: list[np.ndarray] = []
    for point in vertex:
        while len(hull) >= 2 and inward * _cross(hull[-1] - hull[-2], point - hull[-1]) >= 0.0:
            hull.pop()
        hull.append(point)
    kept = np.stack(hull)
    middle, half = 0.5 * (kept[1:] + kept[:-1]), 0.5 * (kept[1:] - kept[:-1])
    depth = distance_to_segment(vertex[:, None, :], middle, half).min(axis=1).max()
    # Inside a wide and deep recess the LiDAR itself would look out through the lid.
    roomy = depth > LIDAR_GAP and 2.0 * np.linalg.norm(half, axis=1).max() > 2.0 * LIDAR_GAP
    return vertex if roomy else kept


def distance_to_segment(point: np.ndarray, middle: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Distance from points to segments `middle ± half`, all `(..., 2)`."""
    from_middle = point - middle
    along = np.sum(from_middle * half, axis=-1) / np.maximum(np.sum(half * half, axis=-1), 1e-12)
    return np.linalg.norm(from_middle - np.clip(along, -1.0, 1.0)[..., None] * half, axis=-1)


def _cross(a: np.ndarray, b: np.ndarray) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _box(vertex: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Centre, half long axis and half thickness of a thin box around a few vertices.

    The thinnest box of a polygon lies along one of its hull's edges, so it is enough to try the directions between
    pairs of vertices.
    """
    first, second = np.triu_indices(len(vertex), k=1)
    edge = vertex[second] - vertex[first]
    size = np.linalg.norm(edge, axis=1)
    # A file may repeat a vertex; a block of nothing else is a point, for which any direction will do.
    edge, size = (edge[size > 1e-9], size[size > 1e-9]) if np.any(size > 1e-9) else (np.eye(2), np.ones(2))
    direction = edge / size[:, None]
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
    across = vertex @ normal.T
    along = vertex @ direction.T
    area = (np.ptp(across, axis=0) + 1e-3) * np.ptp(along, axis=0)
    best = int(np.argmin(area))
    middle = 0.5 * (along[:, best].max() + along[:, best].min()) * direction[best]
    middle = middle + 0.5 * (across[:, best].max() + across[:, best].min()) * normal[best]
    centre = middle.astype(np.float32).astype(np.float64)
    half_length = np.abs((vertex - centre) @ direction[best]).max() + BOX_MARGIN
    half_thickness = np.abs((vertex - centre) @ normal[best]).max() + BOX_MARGIN
    return centre, half_length * direction[best], float(half_thickness)


def _furniture_runs(furniture: np.ndarray, max_segments: int) -> list[np.ndarray]:
    """Loose segments joined, where the next begins at the end of the last, into polylines of a few segments."""
    runs: list[list[np.ndarray]] = []
    for x0, y0, x1, y1 in furniture:
        start, end = np.array([x0, y0]), np.array([x1, y1])
        if runs and len(runs[-1]) <= max_segments and np.allclose(runs[-1][-1], start, rtol=0.0, atol=1e-9):
            runs[-1].append(end)
        else:
            runs.append([start, end])
    return [np.stack(run) for run in runs]


def build_blocks(plan: TunnelPlan, lining: Lining, length: float, max_segments: int) -> Blocks:
    """Cut one lining into blocks.

    Args:
        plan: The tunnel, for its centreline.
        lining: The walls and furniture to cut.
        length: Wanted length of a block, m. A single longer wall segment stays whole.
        max_segments: Most segments in one block.
    """
    pieces: list[np.ndarray] = []
    enclosed: list[np.ndarray] = []
    stations: list[float] = []
    for wall, inward in ((lining.left, -1.0), (lining.right, 1.0)):
        centre = np.stack([np.interp(wall.station, plan.station, plan.centre[:, i]) for i in range(2)], axis=-1)
        for first, last in _cuts(wall, np.linalg.norm(wall.vertex - centre, axis=1), length, max_segments):
            pieces.append(wall.vertex[first : last + 1])
            enclosed.append(_lidded(pieces[-1], inward))
            stations.append(0.5 * (wall.station[first] + wall.station[last]))
    for run in _furniture_runs(lining.furniture, max_segments):
        pieces.append(run)
        enclosed.append(run)
        nearest = np.argmin(np.sum((plan.centre - run.mean(axis=0)) ** 2, axis=1))
        stations.append(float(plan.station[nearest]))
    order = np.argsort(stations, kind="stable")
    n_vertices = max(len(piece) for piece in pieces)
    boxes = [_box(enclosed[i]) for i in order]
    centre = np.stack([box[0] for box in boxes])
    padded = np.stack([np.pad(pieces[i], ((0, n_vertices - len(pieces[i])), (0, 0)), mode="edge") for i in order])
    return Blocks(
        centre=centre,
        half=np.stack([box[1] for box in boxes]),
        thickness=np.array([box[2] for box in boxes]),
        offset=padded - centre[:, None, :],
        station=np.asarray(stations)[order],
    )


def padded(blocks: Blocks, count: int) -> Blocks:
    """At least `count` blocks: the missing ones are points too far away to be seen."""
    missing = max(0, count - len(blocks.centre))
    return Blocks(
        centre=np.pad(blocks.centre, ((0, missing), (0, 0)), constant_values=1e6),
        half=np.pad(blocks.half, ((0, missing), (0, 0))),
        thickness=np.pad(blocks.thickness, (0, missing)),
        offset=np.pad(blocks.offset, ((0, missing), (0, 0), (0, 0))),
        station=np.pad(blocks.station, (0, missing), constant_values=np.inf),
    )
