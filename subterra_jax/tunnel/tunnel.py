"""The tunnel on the device, one or many: the geometry that every step reads, as one pytree."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from subterra_jax.host.errors import TunnelError
from subterra_jax.tunnel.blocks import PADDING_CENTRE, PADDING_THICKNESS, build_blocks
from subterra_jax.tunnel.order import order, windows
from subterra_jax.tunnel.packed import Packed, join, pack
from subterra_jax.tunnel.plan import TunnelPlan

CONTACT_REACH = 0.8
FARTHEST = 2.0**14  # m from the origin: up to there neighbouring numbers of 32 bits are less than 1 mm apart
GROUP = 16  # blocks that a CPU looks at together; there are twice as many of padding on either side of a tunnel
WIDTH = 16  # segments that a CPU looks at together
BLOCK_LENGTH, MOST_SEGMENTS = 2.0, 16  # of a block of wall: m, about; they affect speed alone
# Boxes sorted by where a beam enters them; speed alone. Beside furniture it enters more without touching what is there.
_CANDIDATES, _CANDIDATES_FURNISHED = 4, 5
# What a stack has of each of its tunnels.
_NUMBERS = ("length", "spacing", "ring_pitch", "first_node", "n_nodes", "texture")


@struct.dataclass
class Tunnel:
    """A planar tunnel with one lining, cut into blocks of wall in order of station; or a stack of several such tunnels.

    A stack holds the nodes and the blocks of its tunnels one after another, each tunnel near its own origin, and
    has `k` numbers where one tunnel has one. `pick` gives the view of one tunnel that every function here, `lidar.scan`
    and `vehicle.clearance` work on. Two tunnels or stacks whose arrays have the same shapes share one compiled program.

    Attributes:
        length: Length of the centreline, m; `()`, or `(k,)` in a stack of k, as the next four.
        spacing: Step of the station grid, m.
        ring_pitch: Distance between ring joints, m; 0 without rings.
        first_node: Row of `grid` at station 0.
        n_nodes: Nodes of the station grid.
        texture: Seed of the brightness of its walls, `(k,)` in a stack; -1 where it is not known.
        grid: Centreline x, y (m), unit tangent x, y and half width (m) at each node of the station grid.
        scan_first: First block of the window that a LiDAR near each node can see.
        contact_first: First block of the window that a robot near each node can touch.
        visit_first: First block at or beyond each node: beams visit blocks from there on, and back; see `order.Order`.
        box: Rows of the middle x, y of the box around each block, half its long axis as a vector x, y, half its
            thickness and half its length, m; and of the plane at each block: its normal x, y, and how far ahead and
            behind it is, m; see `order.Order`. Padding, as before the first block, has a negative thickness, so that
            no beam enters it, and nothing beyond its plane.
        wall: Row of x and row of y of the vertices of each block, from the middle of its box, m; the last one repeated
            as padding.
        reach: Largest range for which the scan window was made, m.
        n_scan: Blocks in a scan window. Every window, counted up to the next power of two, holds blocks of one tunnel,
            padding, or nothing.
        n_contact: Blocks in a contact window.
        n_candidates: Boxes that XLA sorts by where a beam enters them; affects speed alone.
        space: Surface and ground, a `lidar3d.space.Space`, for LiDARs in three dimensions; `None` without one.
        packed: Boxes and walls as GPUs read them, a `Packed`. `None` in a tunnel whose `box` or `wall` was replaced:
            XLA casts there.
    """

    length: Float[Array, "*k"]
    spacing: Float[Array, "*k"]
    ring_pitch: Float[Array, "*k"]
    first_node: Int[Array, "*k"]
    n_nodes: Int[Array, "*k"]
    texture: Int[Array, "*k"]
    grid: Float[Array, "all_nodes 5"]
    scan_first: Int[Array, "all_nodes"]
    contact_first: Int[Array, "all_nodes"]
    visit_first: Int[Array, "all_nodes"]
    box: Float[Array, "10 n_blocks"]
    wall: Float[Array, "n_blocks 2 n_vertices"]
    reach: float = struct.field(pytree_node=False)
    n_scan: int = struct.field(pytree_node=False)
    n_contact: int = struct.field(pytree_node=False)
    n_candidates: int = struct.field(pytree_node=False)
    space: Any = None
    packed: Any = None

    @property
    def count(self) -> int:
        """Number of tunnels: 1, or k for a stack."""
        return 1 if jnp.ndim(self.length) == 0 else self.length.shape[0]

    def pick(self, index: Int[Array, ""] | int) -> "Tunnel":
        """Return one tunnel of a stack; itself if there is only one.

        The large arrays stay shared, so that each environment of a batch may pick its own tunnel.

        Args:
            index: Number of the tunnel, from 0 to `count - 1`; not checked.
        """
        if self.count == 1:
            return self
        one = self._with_numbers(*(getattr(self, name)[index] for name in _NUMBERS))
        return one if self.space is None else dataclasses.replace(one, space=self.space.pick(index))

    @property
    def walls(self) -> "Tunnel":
        """The blocks alone, without the numbers that differ among the tunnels of a stack.

        In a batch that picks different tunnels it is one for all.
        """
        bare = dataclasses.replace(self, space=None)
        return bare._with_numbers(*(np.float32(0.0),) * 3, *(np.int32(0),) * 3)

    def _with_numbers(self, *numbers: Any) -> "Tunnel":
        return dataclasses.replace(self, **dict(zip(_NUMBERS, numbers, strict=True)))

    @classmethod
    def from_plan(
        cls,
        plan: TunnelPlan,
        lining: str | None = None,
        *,
        reach: float = 30.0,
    ) -> "Tunnel":
        """Put a plan on the device.

        Args:
            lining: Variant of its walls; `None` is `pockets`, or the first if there is none of that name.
            reach: Largest LiDAR range, m.

        Raises:
            TunnelError: The plan does not have the lining, or lies so far from its origin that 32 bits blur it.
        """
        walls = plan.lining(lining or plan.default_lining)
        if (far := float(np.abs(plan.centre).max())) > FARTHEST:
            raise TunnelError(
                f"tunnel {plan.name!r} reaches {far:.0f} m from the origin of its coordinates, where 32 bits blur "
                f"millimetres: shift it to within {FARTHEST:.0f} m"
            )
        blocks = build_blocks(plan, walls, BLOCK_LENGTH, MOST_SEGMENTS)
        scan_first, in_window = windows(plan, blocks, reach)
        contact_first, in_contact = windows(plan, blocks, CONTACT_REACH)
        visits, n_scan = order(plan, blocks, scan_first, in_window), int(in_window.max())
        half_length = np.linalg.norm(blocks.half, axis=1)
        grid = np.concatenate([plan.centre, plan.tangent, plan.half_width[:, None]], axis=1)
        box = np.column_stack(
            [blocks.centre, blocks.half, blocks.thickness, half_length, visits.normal, visits.ahead, visits.behind]
        ).T.astype(np.float32)
        around = 2 * GROUP  # blocks of padding at either end; no window reaches beyond the last block
        box = np.concatenate([_padding(around), box, _padding(around)], axis=1)
        wall = np.pad(blocks.offset.swapaxes(1, 2).astype(np.float32), ((around, around), (0, 0), (0, 0)))
        wall = np.pad(wall, ((0, 0), (0, 0), (0, (1 - wall.shape[2]) % WIDTH)), mode="edge")
        count = np.pad(blocks.count, around, constant_values=1)
        real, whole = partial(_on_device, dtype=np.float32), partial(_on_device, dtype=np.int32)
        return cls(
            length=real(plan.length),
            spacing=real(plan.station[1] - plan.station[0]),
            ring_pitch=real(plan.ring_pitch),
            first_node=whole(0),
            n_nodes=whole(len(plan.station)),
            texture=whole(-1 if plan.texture is None else plan.texture),
            grid=real(grid),
            scan_first=whole(scan_first + around),
            contact_first=whole(contact_first + around),
            visit_first=whole(visits.start + around),
            box=real(box),
            wall=real(wall),
            reach=reach,
            n_scan=n_scan,
            n_contact=int(in_contact.max()),
            n_candidates=_CANDIDATES if len(walls.furniture) == 0 else _CANDIDATES_FURNISHED,
            packed=jax.device_put(pack(box, wall, count)),
        )


def _on_device(values: Any, dtype: Any) -> Array:
    """Put an array on the device; `jnp.asarray` would compile a program for each new shape."""
    return jax.device_put(np.ascontiguousarray(values, dtype).reshape(np.shape(values)))


@struct.dataclass
class Foot:
    """Position of a point along and across a tunnel."""

    # station of the nearest point of the centreline, m; below 0 or beyond the length outside a mouth
    station: Float[Array, ""]
    lateral: Float[Array, ""]  # distance to the left of the centreline, m
    half_width: Float[Array, ""]  # half the distance between the smooth walls there, m
    tangent: Float[Array, "2"]  # unit tangent of the centreline there


def node_at(tunnel: Tunnel, station: Float[Array, ""]) -> Int[Array, ""]:
    """Return the row of `grid` nearest to a station; beyond a mouth, the last node."""
    place = station / tunnel.spacing
    node = jnp.clip(jnp.round(place), 0, (tunnel.n_nodes - 1).astype(place.dtype))
    return tunnel.first_node + node.astype(jnp.int32)


def at_station(tunnel: Tunnel, station: Float[Array, ""]) -> Float[Array, "5"]:
    """Return centre x, y (m), unit tangent x, y and half width (m) at a station; straight on beyond the mouths."""
    place = station / tunnel.spacing
    node = jnp.clip(jnp.floor(place), 0, (tunnel.n_nodes - 2).astype(place.dtype))
    index, fraction = node.astype(jnp.int32), place - node
    row = tunnel.first_node + index
    lower, upper = tunnel.grid[row], tunnel.grid[row + 1]
    return lower + fraction * (upper - lower)


def beside(
    tunnel: Tunnel, station: Float[Array, ""], lateral: Float[Array, ""]
) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """Return the point that lies `lateral` m to the left of the centreline at a station, m, and its heading there."""
    x, y, tangent_x, tangent_y, _ = at_station(tunnel, station)
    position = jnp.stack([x - lateral * tangent_y, y + lateral * tangent_x])
    return position, jnp.arctan2(tangent_y, tangent_x)


def foot(tunnel: Tunnel, position: Float[Array, "2"], near: Float[Array, ""]) -> Foot:
    """Return the foot of the perpendicular from a point (m) to the centreline.

    It is searched near a station within about half a metre of the answer, m, such as the previous one. Each of the two
    passes shrinks the error by lateral offset over radius of curvature: from 0.2 m to 0.3 mm in a bend of 60 m, 2.4 m
    off the centreline.
    """
    station = near
    for _ in range(2):
        centre_x, centre_y, tangent_x, tangent_y, half_width = at_station(tunnel, station)
        from_x, from_y = position[0] - centre_x, position[1] - centre_y
        lateral = tangent_x * from_y - tangent_y * from_x
        station = station + tangent_x * from_x + tangent_y * from_y
    return Foot(station=station, lateral=lateral, half_width=half_width, tangent=jnp.stack([tangent_x, tangent_y]))


def stack(tunnels: Sequence[Tunnel]) -> Tunnel:
    """Join several tunnels into one `Tunnel`; `pick(i)` gives the i-th. Nodes and blocks follow one another.

    Windows are as large as the largest of any tunnel. Behind its last block each tunnel is padded so that no window,
    counted up to the next power of two, reaches the next tunnel.

    A stack costs memory that no longer fits a cache: about a fifth of the speed for 1,000 tunnels on an H100, half as
    much again for 100 on a CPU.

    Args:
        tunnels: One or more single tunnels, of any length and lining.

    Returns:
        The stack, with the least `reach` of any; a single tunnel is returned unchanged.

    Raises:
        ValueError: The list is empty, or one of them is a stack itself.
    """
    if not tunnels:
        raise ValueError("a stack needs at least one tunnel, got none")
    for i, tunnel in enumerate(tunnels):
        if tunnel.length.ndim:
            raise ValueError(f"tunnel {i} is a stack of {tunnel.count} tunnels itself")
    if len(tunnels) == 1:
        return tunnels[0]
    n_scan, n_contact = max(t.n_scan for t in tunnels), max(t.n_contact for t in tunnels)
    n_vertices = max(t.wall.shape[2] for t in tunnels)
    parts = [_pad(t, n_scan, n_contact, n_vertices) for t in tunnels]
    n_blocks, n_nodes = np.array([box.shape[1] for box, _ in parts]), np.array([t.grid.shape[0] for t in tunnels])
    first_block, first_node = (np.concatenate([[0], np.cumsum(n)[:-1]]).astype(np.int32) for n in (n_blocks, n_nodes))
    box, wall = np.concatenate([box for box, _ in parts], axis=1), np.concatenate([wall for _, wall in parts])
    put = jax.device_put  # `jnp.asarray` would compile a program for each new shape
    numbers = {name: put(np.stack([np.asarray(getattr(t, name)) for t in tunnels])) for name in _NUMBERS}
    shifted = {
        name: put(np.concatenate([np.asarray(getattr(t, name)) + b for t, b in zip(tunnels, first_block, strict=True)]))
        for name in ("scan_first", "contact_first", "visit_first")
    }
    return Tunnel(
        **{**numbers, "first_node": put(first_node)},
        **shifted,
        grid=put(np.concatenate([np.asarray(t.grid) for t in tunnels])),
        box=put(box),
        wall=put(wall),
        reach=min(t.reach for t in tunnels),
        n_scan=n_scan,
        n_contact=n_contact,
        n_candidates=max(t.n_candidates for t in tunnels),
        space=None if tunnels[0].space is None else tunnels[0].space.join([t.space for t in tunnels]),
        packed=_join_packed(tunnels, n_blocks),
    )


def _pad(tunnel: Tunnel, n_scan: int, n_contact: int, n_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """Return box and wall of a tunnel, padded so that none of its windows reaches beyond them."""
    box, wall = np.asarray(tunnel.box), np.asarray(tunnel.wall)
    # A beam that enters no box reads the block whose number has all bits set.
    window = 1 << (n_scan - 1).bit_length()
    needed = max(
        int(np.asarray(tunnel.scan_first).max()) + window, int(np.asarray(tunnel.contact_first).max()) + n_contact
    )
    missing = max(0, needed - box.shape[1])
    wall = np.pad(wall, ((0, 0), (0, 0), (0, n_vertices - wall.shape[2])), mode="edge")
    return np.concatenate([box, _padding(missing)], axis=1), np.pad(wall, ((0, missing), (0, 0), (0, 0)))


def _padding(count: int) -> np.ndarray:
    """Return boxes that nothing enters, with nothing beyond their planes."""
    fill = np.zeros((10, count), np.float32)
    fill[:2], fill[4], fill[6], fill[8:] = PADDING_CENTRE, PADDING_THICKNESS, 1.0, np.inf
    return fill


def _join_packed(tunnels: Sequence[Tunnel], n_blocks: np.ndarray) -> Packed | None:
    if any(t.packed is None for t in tunnels):
        return None
    parts = []
    for tunnel, n in zip(tunnels, n_blocks, strict=True):
        missing = int(n) - len(tunnel.packed.block)
        end = pack(_padding(missing), np.zeros((missing, 2, 2), np.float32), np.ones(missing, int))
        parts += [tunnel.packed, end] if missing else [tunnel.packed]
    return jax.device_put(join(parts))
