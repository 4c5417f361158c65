"""The bore's inner surface in three dimensions, on the device: what a tilted or many-beam LiDAR sees, as one pytree."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from subterra_jax.lidar3d.frames import Blocks, cut_blocks
from subterra_jax.lidar3d.surface import SMALL, Axis, Triangles, read_axis, read_scene
from subterra_jax.lidar3d.voxels import Voxels, fill_voxels


@struct.dataclass
class Relief:
    """Every triangle of a bore's surface, in voxels that follow its axis.

    Two reliefs whose arrays have the same shapes share one compiled program; see `Relief.padded`.

    Attributes:
        length: Length of the axis, m.
        n_blocks: Blocks that the axis is cut into; further ones are padding.
        frame: Of each block: its origin (3, m), the axes of its frame as rows (9), the planes where it begins and where
            it ends as normal and offset in that frame (4 and 4, m).
        low: Lower corner of the voxels in a block's frame, m.
        cell: Sizes of a voxel, m.
        code: List of the triangles of each voxel; where there is none, minus the number of voxels to the nearest that
            has one.
        first: Where each list begins in `member`.
        member: Rows of `triangle`.
        triangle: A corner and the two edges from it, in the frame of the triangle's block, m.
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
        """Make a scene folder's visible surface ready for the device; takes some seconds for each kilometre.

        Args:
            folder: A scene folder, as `scene.build` writes it.
            lining: `smooth`, `pockets`, or `furnished`, which brings the furniture along.
            leave_out: Kinds of geom that the LiDAR does not see; rails' clips and the lining's bolts by default.

        Raises:
            TunnelError: No such lining, or a file of the folder is missing or spoiled.
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
        """Make any surface around an axis ready for the device.

        Args:
            axis: The axis; its ends are the mouths, beyond which nothing is hit.
            surface: The triangles.
            block_length: Wanted length of the straight frames, m; speed alone depends on it.
            cell: Wanted size of a voxel along, across and upwards, m; speed alone depends on it.

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

    def padded(self, other: "Relief") -> "Relief":
        """The same relief, its arrays no smaller than another's; padded by each other, two agree in shape."""

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
        """Memory on the device."""
        return sum(leaf.nbytes for leaf in jax.tree.leaves(self))


def _frames(blocks: Blocks) -> np.ndarray:
    return np.concatenate([blocks.centre, blocks.turn.reshape(-1, 9), blocks.back, blocks.front], axis=1)


def _arrays(voxels: Voxels) -> dict[str, Array]:
    floats = {name: jnp.asarray(getattr(voxels, name), jnp.float32) for name in ("low", "cell", "triangle")}
    return floats | {name: jnp.asarray(getattr(voxels, name), jnp.int32) for name in ("code", "first", "member")}
