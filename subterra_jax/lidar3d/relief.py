"""The inner surface of a bore on the device, as one pytree: the geometry that a tilted or many-beam LiDAR measures.

The bore is cut into straight blocks, and its triangles are sorted into the voxels of each block, so that a ray meets
only the few triangles near it. Voxels are long along the axis because walls are. This runs once, on the host, in
float64. No triangle is simplified; each is listed in every voxel within `MARGIN` of it.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int
from scipy.ndimage import distance_transform_cdt
from scipy.spatial import cKDTree

from subterra_jax.lidar3d.surface import SMALL, Axis, Triangles, read_axis, read_scene


@dataclasses.dataclass(frozen=True)
class Blocks:
    """Straight blocks along the axis, each with its own frame.

    Attributes:
        centre: Origin of each frame, exactly representable in float32, m, `(b, 3)`.
        turn: Axes of the frame as rows: along, left, up, exactly representable in float32, `(b, 3, 3)`.
        back: Plane where the block begins, in its own frame, as a unit normal along the axis and an offset:
            inside, `normal · point >= offset`; m, `(b, 4)`.
        front: Plane where the block ends; inside, `normal · point <= offset`; m, `(b, 4)`.
        ends: Stations of the two planes, m, `(b, 2)`.
    """

    centre: Float[np.ndarray, "b 3"]
    turn: Float[np.ndarray, "b 3 3"]
    back: Float[np.ndarray, "b 4"]
    front: Float[np.ndarray, "b 4"]
    ends: Float[np.ndarray, "b 2"]


def cut_blocks(
    station: Float[np.ndarray, "n"],
    position: Float[np.ndarray, "n 3"],
    tangent: Float[np.ndarray, "n 3"],
    length: float,
) -> Blocks:
    """Cut the axis into blocks of about `length` m; one block if it is shorter."""
    joint = np.linspace(0.0, station[-1], max(1, round(station[-1] / length)) + 1)

    def at(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(joint, station, column) for column in values.T], axis=-1)

    point, normal = at(position), at(tangent)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    centre = _as_float32((point[1:] + point[:-1]) / 2)
    along = point[1:] - point[:-1]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    left = np.cross([0.0, 0.0, 1.0], along)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    turn = _as_float32(np.stack([along, left, np.cross(along, left)], axis=1))

    def plane(which: slice) -> np.ndarray:
        facing = np.einsum("bij,bj->bi", turn, normal[which])
        offset = np.einsum("bij,bj->bi", turn, point[which] - centre)
        return np.column_stack([facing, np.sum(facing * offset, axis=1)])

    ends = np.column_stack([joint[:-1], joint[1:]])
    return Blocks(centre, turn, plane(slice(None, -1)), plane(slice(1, None)), ends)


def _as_float32(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(np.float64)


# A ray may step this far over the face of a voxel without leaving what the voxel lists, m.
MARGIN = 1e-3


@dataclasses.dataclass(frozen=True)
class Voxels:
    """Triangles sorted by voxel.

    Attributes:
        low: Lower corner of every block's grid in its frame, m, `(3,)`.
        cell: Sizes of a voxel, m, `(3,)`.
        code: Number of each voxel's list by block and voxel; without a list, minus the Chebyshev distance in voxels to
            the nearest voxel with one, `(b, nx, ny, nz)`.
        first: Start of each list in `member`, and end of the last, `(k + 1,)`.
        member: Rows of `triangle`, list after list, `(p,)`.
        triangle: One corner and the two edges from it, in the block's frame, m, `(t, 9)`. A triangle in two blocks has
            two rows.
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
        blocks: The blocks.
        station: Stations of the axis, m.
        position: Positions of the axis, m.
        vertices: Vertices of the triangles, m.
        faces: Triangles as rows of `vertices`.
        cell: Target size of a voxel along, across and upwards, m.

    Raises:
        ValueError: No triangle lies along the axis.
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
    return _list_triangles(parts, low, size, count)


def _list_triangles(parts: list[np.ndarray], low: np.ndarray, cell: np.ndarray, count: np.ndarray) -> Voxels:
    """List the triangles of every voxel of all blocks."""
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
    """Pair triangles with the flat numbers of voxels near them; voxels at the grid's ends reach to infinity."""
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
    """Return whether triangles and voxels overlap.

    Source: separating-axis theorem for convex bodies; of its 13 axes the caller has tested the box's own three.
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


@struct.dataclass
class Relief:
    """Every triangle of a bore's surface, in voxels that follow its axis.

    Two reliefs whose arrays have the same shapes share one compiled program; see `Relief.pad_to`.

    Attributes:
        length: Length of the axis, m.
        n_blocks: Blocks of the axis; further rows are padding.
        frame: Frame of each block: origin (3, m), axes as rows (9), planes of its two ends as normal and offset in that
            frame (4 and 4, m).
        low: Lower corner of the voxels in a block's frame, m.
        cell: Sizes of a voxel, m.
        code: As in `Voxels`.
        first: Start of each list in `member`.
        member: Rows of `triangle`, list after list.
        triangle: As in `Voxels`, m.
    """

    length: Float[Array, ""]
    n_blocks: Int[Array, ""]
    frame: Float[Array, "n_frames 20"]
    low: Float[Array, "3"]
    cell: Float[Array, "3"]
    code: Int[Array, "n_frames nx ny nz"]
    first: Int[Array, "n_lists"]
    member: Int[Array, "n_members"]
    triangle: Float[Array, "n_triangles 9"]

    @classmethod
    def from_scene(cls, folder: str | Path, lining: str = "pockets", *, leave_out: tuple[str, ...] = SMALL) -> "Relief":
        """Put a scene folder's visible surface on the device; takes some seconds per kilometre.

        Args:
            folder: A scene folder, as `scene.build` writes it.
            lining: `smooth`, `pockets`, or `furnished`, which brings the furniture along.
            leave_out: Kinds of geom to leave out; by default the rails' clips and the lining's bolts.

        Raises:
            TunnelError: The lining is unknown, or a file of the folder is missing or damaged.
        """
        folder = Path(folder)
        axis = read_axis(folder / "bore.npz")
        return cls.from_triangles(axis, read_scene(folder, lining, leave_out))

    @classmethod
    def from_triangles(
        cls,
        axis: Axis,
        surface: Triangles,
        *,
        block_length: float = 8.0,
        cell: tuple[float, float, float] = (0.4, 0.15, 0.15),
    ) -> "Relief":
        """Put a surface around an axis on the device.

        Args:
            axis: The axis; beyond its ends, the mouths, a ray hits nothing.
            surface: The triangles.
            block_length: Target length of a block, m; affects speed alone.
            cell: Target size of a voxel along, across and upwards, m; affects speed alone.

        Raises:
            ValueError: No triangle lies along the axis.
        """
        blocks = cut_blocks(axis.station, axis.position, axis.tangent, block_length)
        voxels = fill_voxels(blocks, axis.station, axis.position, surface.vertices, surface.faces, cell)
        return cls(
            length=jnp.float32(axis.station[-1]),
            n_blocks=jnp.int32(len(blocks.centre)),
            frame=jnp.asarray(_frames(blocks), jnp.float32),
            **_arrays(voxels),
        )

    def pad_to(self, other: "Relief") -> "Relief":
        """Pad the arrays to at least another relief's sizes; two reliefs padded by each other agree in shape."""

        def grown(mine: Array, theirs: Array, fill: int | None) -> Array:
            room = [(0, max(0, b - a)) for a, b in zip(mine.shape, theirs.shape, strict=True)]
            return jnp.pad(mine, room, mode="edge") if fill is None else jnp.pad(mine, room, constant_values=fill)

        return self.replace(  # type: ignore[attr-defined]
            frame=grown(self.frame, other.frame, None),
            code=grown(self.code, other.code, -1),
            first=grown(self.first, other.first, None),
            member=grown(self.member, other.member, None),
            triangle=grown(self.triangle, other.triangle, None),
        )

    @property
    def n_bytes(self) -> int:
        """Memory on the device, bytes."""
        return sum(leaf.nbytes for leaf in jax.tree.leaves(self))


def _frames(blocks: Blocks) -> np.ndarray:
    return np.concatenate([blocks.centre, blocks.turn.reshape(-1, 9), blocks.back, blocks.front], axis=1)


def _arrays(voxels: Voxels) -> dict[str, Array]:
    floats = {name: jnp.asarray(getattr(voxels, name), jnp.float32) for name in ("low", "cell", "triangle")}
    return floats | {name: jnp.asarray(getattr(voxels, name), jnp.int32) for name in ("code", "first", "member")}
