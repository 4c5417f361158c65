"""Triangles sorted into voxels that follow the bore, so that a ray need only meet the few near it.

Each block of the bore has a grid of voxels in its own frame, long along the axis because walls are. Everything here
runs once, on the host, in float64; no triangle is simplified, and each is listed in every voxel within `MARGIN` of it.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_cdt
from scipy.spatial import cKDTree

from subterra_jax.lidar3d.frames import Blocks

# A ray may step this far over the face of a voxel without leaving what the voxel lists, m.
MARGIN = 1e-3


@dataclasses.dataclass(frozen=True)
class Voxels:
    """Triangles by voxel.

    Attributes:
        low: Lower corner of every block's grid in its frame, m, `(3,)`.
        cell: Sizes of a voxel, m, `(3,)`.
        code: By block and voxel, the number of its list; of a voxel without one, minus the number of voxels, in the
            Chebyshev sense, to the nearest that has one, `(b, nx, ny, nz)`.
        first: Where each list begins in `member`, and where the last ends, `(k + 1,)`.
        member: Rows of `triangle`, list after list, `(p,)`.
        triangle: A corner and the two edges from it, in the frame of its block, m, `(t, 9)`. A triangle that lies in
            two blocks has two rows.
    """

    low: Float[np.ndarray, "3"]
    cell: Float[np.ndarray, "3"]
    code: Int[np.ndarray, "b nx ny nz"]
    first: Int[np.ndarray, "k1"]
    member: Int[np.ndarray, "p"]
    triangle: Float[np.ndarray, "t 9"]


def fill_voxels(
    blocks: Blocks,
    station: Float[np.ndarray, "n"],
    position: Float[np.ndarray, "n 3"],
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    cell: tuple[float, float, float],
) -> Voxels:
    """Sort triangles into voxels.

    Args:
        blocks: The frames.
        station: Of the axis, m.
        position: Of the axis, m.
        vertices: m.
        faces: Rows of `vertices`.
        cell: Wanted size of a voxel along, across and upwards, m.
    """
    near = station[cKDTree(position).query(vertices)[1]][faces]
    reach = np.linalg.norm(np.ptp(vertices[faces], axis=1), axis=1) + 2.0 * (station[1] - station[0])
    low_station, high_station = near.min(axis=1) - reach, near.max(axis=1) + reach
    parts = []
    for k in range(len(blocks.centre)):
        close = np.flatnonzero((high_station >= blocks.ends[k, 0]) & (low_station <= blocks.ends[k, 1]))
        corner = (vertices[faces[close]] - blocks.centre[k]) @ blocks.turn[k].T
        within = (corner @ blocks.front[k, :3] - blocks.front[k, 3]).min(axis=1) <= MARGIN
        within &= (corner @ blocks.back[k, :3] - blocks.back[k, 3]).max(axis=1) >= -MARGIN
        parts.append(corner[within])
    extent = np.concatenate([part.reshape(-1, 3) for part in parts])
    if not len(extent):
        raise ValueError("no triangle lies along the axis")
    low, high = extent.min(axis=0) - 0.01, extent.max(axis=0) + 0.01
    # The ends of the grid reach to infinity, so along the axis it need not hold the ends of slanted triangles.
    half = float(np.max(blocks.ends[:, 1] - blocks.ends[:, 0])) / 2
    low[0], high[0] = -half, half
    count = np.maximum(np.ceil((high - low) / np.asarray(cell)), 1).astype(int)
    size = (high - low) / count
    return _listed(parts, low, size, count)


def _listed(parts: list[np.ndarray], low: np.ndarray, cell: np.ndarray, count: np.ndarray) -> Voxels:
    """The lists of all blocks, one after another."""
    code, lengths, members = np.empty((len(parts), *count), np.int32), [], []
    lists = triangles = 0
    for k, corner in enumerate(parts):
        triangle, voxel = _pairs(corner, low, cell, count)
        order = np.lexsort([triangle, voxel])
        taken, number = np.unique(voxel[order], return_counts=True)
        free = np.ones(count.prod(), bool)
        free[taken] = False
        # The transform knows no distance where nothing is taken.
        away = distance_transform_cdt(free.reshape(count), "chessboard") if len(taken) else np.full(count, count.max())
        code[k] = -away
        code[k].reshape(-1)[taken] = lists + np.arange(len(taken))
        lengths.append(number)
        members.append(triangles + triangle[order])
        lists, triangles = lists + len(taken), triangles + len(corner)
    corner = np.concatenate(parts)
    rows = np.concatenate([corner[:, 0], corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=1)
    first = np.concatenate([[0], np.cumsum(np.concatenate(lengths))])
    return Voxels(low, cell, code, first, np.concatenate(members), rows)


def _pairs(
    corner: Float[np.ndarray, "t 3 3"], low: np.ndarray, cell: np.ndarray, count: np.ndarray
) -> tuple[Int[np.ndarray, "p"], Int[np.ndarray, "p"]]:
    """Triangles, and flat numbers of voxels that each comes near; voxels at the grid's ends reach on to infinity."""
    start = _voxel_of(corner.min(axis=1) - MARGIN, low, cell, count)
    stop = _voxel_of(corner.max(axis=1) + MARGIN, low, cell, count) + 1
    span = stop - start
    total = span.prod(axis=1)
    triangle = np.repeat(np.arange(len(corner)), total)
    place = np.arange(len(triangle)) - np.repeat(np.cumsum(total) - total, total)
    of = span[triangle]
    step = np.column_stack([place // (of[:, 1] * of[:, 2]), place // of[:, 2] % of[:, 1], place % of[:, 2]])
    voxel = start[triangle] + step
    # Only where a triangle spans several voxels can it miss one of them.
    unsure = np.flatnonzero((span > 1).sum(axis=1)[triangle] > 1)
    meets = np.ones(len(triangle), bool)
    meets[unsure] = _meets(corner[triangle[unsure]], voxel[unsure], low, cell, count)
    return triangle[meets], np.ravel_multi_index(tuple(voxel[meets].T), tuple(count))


def _voxel_of(point: np.ndarray, low: np.ndarray, cell: np.ndarray, count: np.ndarray) -> np.ndarray:
    return np.clip(np.floor((point - low) / cell), 0, count - 1).astype(int)


def _meets(
    corner: Float[np.ndarray, "p 3 3"],
    voxel: Int[np.ndarray, "p 3"],
    low: np.ndarray,
    cell: np.ndarray,
    count: np.ndarray,
) -> Bool[np.ndarray, "p"]:
    """Whether no plane square to the triangle or to an axis and one of its edges parts triangle and voxel.

    Source: separating-axis theorem for convex bodies; of its 13 axes the box's own three are settled by the caller.
    """
    half = cell / 2 + MARGIN
    inner = np.all((voxel > 0) & (voxel < count - 1), axis=1)
    centre = low + (voxel + 0.5) * cell
    corner = corner - centre[:, None]
    edge = np.roll(corner, -1, axis=1) - corner
    apart = np.zeros(len(corner), bool)
    normal = np.cross(edge[:, 0], edge[:, 1])
    for axis in [normal, *(np.cross(edge[:, k], np.eye(3)[i]) for k in range(3) for i in range(3))]:
        along = np.einsum("pki,pi->pk", corner, axis)
        radius = np.abs(axis) @ half
        apart |= (along.min(axis=1) > radius) | (along.max(axis=1) < -radius)
    return ~(apart & inner)
