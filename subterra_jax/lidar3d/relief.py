"""The inner surface of one bore or of many on the device: the geometry that a tilted or many-beam LiDAR measures."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from subterra_jax.lidar3d.cells import N_FACES, N_WEDGES, N_X, STEP_BITS, X_BITS, Cells, sort_triangles
from subterra_jax.lidar3d.rolled import raise_shell
from subterra_jax.lidar3d.surface import Axis, Triangles
from subterra_jax.lidar3d.upright import raise_walls
from subterra_jax.tunnel.plan import TunnelPlan

# Numbers of a block: origin (3, m), axes as rows (9), planes of its two ends as normal and offset in that frame (4 and
# 4, m), least place along the axis (m), cells a metre, units of a vertex along and across the axis (1/m), upper end
# of its boxes (m), prism.
N_FRAME = 25 + N_FACES
# Whole numbers of a block: the blocks behind and ahead, -1 at a mouth; first vertex, first cell, first box, boxes.
N_LINK = 6
BLOCK_LENGTH = 4.0  # m, about
ARRAYS = ("frame", "link", "cell", "entry", "vertex", "box")


@struct.dataclass
class Relief:
    """Every triangle of a bore's surface, in cells around its axis; or of several bores.

    Two reliefs whose arrays have the same shapes share one compiled program.

    Attributes:
        length: Length of the axis, m; `()`, or `(k,)` in a stack of k, as the next two.
        first_block: First block of the axis.
        n_blocks: Blocks of the axis.
        frame: Numbers of each block, see `N_FRAME`.
        link: Whole numbers of each block, see `N_LINK`.
        cell: As in `Cells`.
        entry: As in `Cells`.
        vertex: As in `Cells`.
        box: As in `Cells`.
    """

    length: Float[Array, "*k"]
    first_block: Int[Array, "*k"]
    n_blocks: Int[Array, "*k"]
    frame: Float[Array, "all_blocks n_frame"]
    link: Int[Array, "all_blocks n_link"]
    cell: Int[Array, "n_cells 2"]
    entry: Int[Array, "n_entries"]
    vertex: Int[Array, "n_vertices 2"]
    box: Float[Array, "n_boxes 12"]

    @classmethod
    def from_plan(cls, plan: TunnelPlan, lining: str | None = None) -> "Relief":
        """Put a tunnel on the device; takes some seconds per kilometre.

        A plan with a shell gives the bore as surveyed, with recesses, track and furniture. One without knows its walls
        at the LiDAR's height alone: they stand upright between floor and crown, and level beams meet what the planar
        LiDAR meets.

        Args:
            lining: Variant of its walls; `None` is `pockets`, or the first if there is none of that name.

        Raises:
            TunnelError: The plan does not have the lining, or has no shell and a LiDAR above the assumed crown.
        """
        if plan.shell is not None:
            return cls.from_triangles(*raise_shell(plan.shell, lining or plan.default_lining))
        return cls.from_triangles(*raise_walls(plan, lining))

    @classmethod
    def from_triangles(cls, axis: Axis, surface: Triangles) -> "Relief":
        """Put a surface around an axis on the device.

        Args:
            axis: The axis; beyond its ends, the mouths, a ray hits nothing.

        Raises:
            ValueError: No triangle lies along the axis.
            TunnelError: A quarter of a metre of the bore has too many triangles.
        """
        cells = sort_triangles(axis, surface, BLOCK_LENGTH)
        n_blocks = len(cells.low)
        return cls(
            length=_put(axis.station[-1], np.float32),
            first_block=_put(0, np.int32),
            n_blocks=_put(n_blocks, np.int32),
            frame=_put(_frames(cells), np.float32),
            link=_put(_links(cells), np.int32),
            cell=_put(cells.cell, np.int32),
            entry=_put(cells.entry, np.int32),
            vertex=_put(cells.vertex, np.int32),
            box=_put(cells.box if len(cells.box) else np.zeros((1, 12)), np.float32),
        )

    @property
    def count(self) -> int:
        """Number of bores: 1, or k for a stack."""
        return 1 if np.ndim(self.length) == 0 else self.length.shape[0]

    def pick(self, index: Int[Array, ""] | int) -> "Relief":
        """Return one bore of a stack, its large arrays shared; itself if there is only one.

        Args:
            index: Number of the bore, from 0 to `count - 1`; not checked.
        """
        if self.count == 1:
            return self
        return self._with_numbers(self.length[index], self.first_block[index], self.n_blocks[index])

    @property
    def shared(self) -> "Relief":
        """The large arrays alone: in a batch that picks different bores of a stack they are one for all."""
        return self._with_numbers(np.float32(0.0), np.int32(0), np.int32(0))

    def _with_numbers(self, length: Any, first_block: Any, n_blocks: Any) -> "Relief":
        return dataclasses.replace(self, length=length, first_block=first_block, n_blocks=n_blocks)


def stack_reliefs(reliefs: Sequence[Relief]) -> Relief:
    """Join several bores into one `Relief`, whose `pick(i)` gives the i-th.

    Args:
        reliefs: One or more single bores.

    Returns:
        The stack; a single bore is returned unchanged.

    Raises:
        ValueError: The list is empty, or one of them is a stack itself.
    """
    if not reliefs:
        raise ValueError("a stack needs at least one relief, got none")
    for i, relief in enumerate(reliefs):
        if relief.count > 1:
            raise ValueError(f"relief {i} is a stack of {relief.count} reliefs itself")
    if len(reliefs) == 1:
        return reliefs[0]
    parts = {name: [np.asarray(getattr(r, name)) for r in reliefs] for name in ARRAYS}
    first = {name: np.cumsum([0, *(len(a) for a in arrays[:-1])]) for name, arrays in parts.items()}
    if max(first[name][-1] + len(parts[name][-1]) for name in parts) >= 1 << 31:
        raise ValueError(f"{len(reliefs)} reliefs have more than 2^31 entries together: stack fewer")
    for i, link in enumerate(parts["link"]):
        shift = np.array([first["frame"][i]] * 2 + [first["vertex"][i], first["cell"][i], first["box"][i], 0])
        parts["link"][i] = np.where(link < 0, -1, link + shift)
        parts["cell"][i] = parts["cell"][i] + np.array([first["entry"][i], 0])
    return Relief(
        length=_put(np.stack([np.asarray(r.length) for r in reliefs]), np.float32),
        first_block=_put(first["frame"], np.int32),
        n_blocks=_put(np.stack([np.asarray(r.n_blocks) for r in reliefs]), np.int32),
        **{name: _put(np.concatenate(arrays), arrays[0].dtype) for name, arrays in parts.items()},
    )


def block_contents(relief: Relief, block: int) -> tuple[Float[np.ndarray, "t 3 3"], Float[np.ndarray, "k 3 4"]]:
    """Return the corners of a block's triangles in its frame, m, and its boxes as in `Cells.box`; on the host."""
    *_, first_vertex, first_cell, first_box, n_boxes = np.asarray(relief.link[block]).tolist()
    cell = np.asarray(relief.cell[first_cell : first_cell + N_X * N_WEDGES]).view(np.uint32)
    first_entry, n_entries = int(cell[0, 0]), int((cell[:, 1] >> 16).sum())
    code = np.unique(np.asarray(relief.entry[first_entry : first_entry + n_entries]).view(np.uint32)).astype(np.int64)
    first, most = code >> 2 * STEP_BITS, (1 << STEP_BITS) - 1
    steps = np.stack([np.zeros_like(code), code >> STEP_BITS & most, code & most], axis=-1)
    number = first_vertex + first[:, None] + steps
    half, word = X_BITS // 2, np.asarray(relief.vertex[number.min(initial=0) : number.max(initial=0) + 1])
    low = word & ((1 << half) - 1)
    along = (low[:, 0] << half | low[:, 1]) - (1 << X_BITS - 1)
    place = np.column_stack([along, word >> half]) / np.asarray(relief.frame[block], np.float64)[[22, 23, 23]]
    box = np.asarray(relief.box[first_box : first_box + n_boxes], np.float64).reshape(-1, 3, 4)
    return place[number - number.min(initial=0)], box


def _put(values: Any, dtype: Any) -> Array:
    """Put an array on the device; `jnp.asarray` would compile a program for each new shape."""
    return jax.device_put(np.ascontiguousarray(values, dtype).reshape(np.shape(values)))


def _frames(cells: Cells) -> Float[np.ndarray, "b n_frame"]:
    blocks, n = cells.blocks, len(cells.low)
    numbers = np.broadcast_to([1.0 / cells.pitch, *(1.0 / cells.unit)], (n, 3))
    parts = [blocks.centre, blocks.turn.reshape(-1, 9), blocks.back, blocks.front, cells.low[:, None], numbers]
    return np.concatenate([*parts, cells.box_top[:, None], cells.prism], axis=1)


def _links(cells: Cells) -> Int[np.ndarray, "b n_link"]:
    n = len(cells.low)
    behind, ahead = np.arange(n) - 1, np.arange(n) + 1
    ahead[-1] = -1
    boxes = cells.first_box[:-1], np.diff(cells.first_box)
    return np.stack([behind, ahead, cells.first_vertex, np.arange(n) * (len(cells.cell) // n), *boxes], axis=-1)
