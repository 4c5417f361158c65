"""The tunnel on the device: what the simulator reads at every step, as one pytree."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from subterra_jax.blocks import build_blocks, padded
from subterra_jax.plan import TunnelPlan, load_tunnel
from subterra_jax.windows import separation, windows

CONTACT_REACH = 0.8
_CANDIDATES, _CANDIDATES_FURNISHED = 3, 8


@struct.dataclass
class Tunnel:
    """A planar tunnel with one lining, cut into blocks of wall in order of station.

    Two tunnels whose arrays have the same shapes share one compiled program.

    Attributes:
        length: Length of the centreline, m.
        spacing: Step of the chainage grid, m.
        grid: Centreline x, y (m), unit tangent x, y and half-width (m) at each node of the chainage grid.
        scan_first: First block of the window that a LiDAR near each node can see.
        contact_first: First block of the window that a robot near each node can touch.
        box: Rows of the middle x, y of the box around each block, half its long axis as a vector x, y, half its
            thickness and half its length, m.
        wall: Row of x and row of y of the vertices of each block, from the middle of its box, m; the last one repeated
            as padding.
        reach: Largest range for which the scan window was made, m.
        n_scan: Blocks in a scan window; even, and blocks half a window apart are further apart than `reach`.
        n_contact: Blocks in a contact window.
        n_candidates: Blocks in which a beam looks for its hit, nearest first.
    """

    length: Float[Array, ""]
    spacing: Float[Array, ""]
    grid: Float[Array, "n_nodes 5"]
    scan_first: Int[Array, "n_nodes"]
    contact_first: Int[Array, "n_nodes"]
    box: Float[Array, "6 n_blocks"]
    wall: Float[Array, "n_blocks 2 n_vertices"]
    reach: float = struct.field(pytree_node=False)
    n_scan: int = struct.field(pytree_node=False)
    n_contact: int = struct.field(pytree_node=False)
    n_candidates: int = struct.field(pytree_node=False)

    @classmethod
    def from_plan(
        cls,
        plan: TunnelPlan,
        lining: str = "pockets",
        *,
        reach: float = 30.0,
        block_length: float = 2.0,
        max_segments: int = 16,
        n_candidates: int | None = None,
    ) -> "Tunnel":
        """Make a plan ready for the device.

        Args:
            plan: The tunnel as read from its file.
            lining: The variant of its walls to use.
            reach: Largest range that a LiDAR will ask for, m.
            block_length: Wanted length of the blocks of wall, m; speed alone depends on it.
            max_segments: Most wall segments in one block; speed alone depends on it.
            n_candidates: Blocks in which a beam looks for its hit. A beam may graze the boxes of one or two blocks
                without touching their walls: with 2, about one random beam in 10⁶ misses its wall; with 3, none in 10⁷.
                None is 3, and 8 where there is furniture, beside which a beam grazes more of them.

        Raises:
            TunnelError: The plan has no such lining.
        """
        blocks = build_blocks(plan, plan.lining(lining), block_length, max_segments)
        if n_candidates is None:
            n_candidates = _CANDIDATES if len(plan.lining(lining).furniture) == 0 else _CANDIDATES_FURNISHED
        scan_first, n_scan = windows(plan, blocks, reach)
        n_scan = 2 * max(-(-n_scan // 2), separation(blocks, reach))
        # A slice beyond the end would start earlier than asked for.
        blocks = padded(blocks, int(scan_first.max()) + n_scan)
        contact_first, n_contact = windows(plan, blocks, CONTACT_REACH)
        half_length = np.linalg.norm(blocks.half, axis=1)
        grid = np.concatenate([plan.centre, plan.tangent, plan.half_width[:, None]], axis=1)
        return cls(
            length=jnp.float32(plan.length),
            spacing=jnp.float32(plan.station[1] - plan.station[0]),
            grid=jnp.asarray(grid, jnp.float32),
            scan_first=jnp.asarray(scan_first, jnp.int32),
            contact_first=jnp.asarray(contact_first, jnp.int32),
            box=jnp.asarray(
                np.column_stack([blocks.centre, blocks.half, blocks.thickness, half_length]).T, jnp.float32
            ),
            wall=jnp.asarray(blocks.offset.swapaxes(1, 2), jnp.float32),
            reach=reach,
            n_scan=n_scan,
            n_contact=n_contact,
            n_candidates=n_candidates,
        )


@struct.dataclass
class Foot:
    """Where a point lies along a tunnel.

    Attributes:
        station: Chainage of the nearest point of the centreline, m; below 0 or beyond the length outside a mouth.
        lateral: Distance to the left of the centreline, m.
        half_width: Half the distance between the smooth walls there, m.
        tangent: Unit tangent of the centreline there.
    """

    station: Float[Array, ""]
    lateral: Float[Array, ""]
    half_width: Float[Array, ""]
    tangent: Float[Array, "2"]


def node_at(tunnel: Tunnel, station: Float[Array, ""]) -> Int[Array, ""]:
    """Index of the node of the chainage grid nearest to a station; a station beyond a mouth gives the last node."""
    n_nodes = tunnel.grid.shape[0]
    return jnp.clip(jnp.round(station / tunnel.spacing), 0, n_nodes - 1).astype(jnp.int32)


def at_station(tunnel: Tunnel, station: Float[Array, ""]) -> Float[Array, "5"]:
    """Centre x, y (m), unit tangent x, y and half-width (m) at a station; straight on beyond the mouths."""
    place = station / tunnel.spacing
    index = jnp.clip(jnp.floor(place), 0, tunnel.grid.shape[0] - 2).astype(jnp.int32)
    share = place - index
    lower, upper = tunnel.grid[index], tunnel.grid[index + 1]
    return lower + share * (upper - lower)


def foot(tunnel: Tunnel, position: Float[Array, "2"], near: Float[Array, ""]) -> Foot:
    """Foot of the perpendicular from a point to the centreline, sought near a known station.

    Args:
        tunnel: The tunnel.
        position: The point, tunnel frame, m.
        near: A station within about half a metre of the answer, m: the previous one, say.

    Returns:
        The foot. Each of the two passes shrinks the error by lateral offset over radius of curvature: from 0.2 m to
        0.3 mm in a bend of 60 m, 2.4 m off the centreline.
    """
    station = near
    for _ in range(2):
        centre_x, centre_y, tangent_x, tangent_y, half_width = at_station(tunnel, station)
        from_x, from_y = position[0] - centre_x, position[1] - centre_y
        lateral = tangent_x * from_y - tangent_y * from_x
        station = station + tangent_x * from_x + tangent_y * from_y
    return Foot(station=station, lateral=lateral, half_width=half_width, tangent=jnp.stack([tangent_x, tangent_y]))


def resolve(
    tunnel: Tunnel | TunnelPlan | str | Path | None,
    lining: str,
    piece: tuple[float, float] | None,
    reach: float,
) -> Tunnel:
    """A device tunnel from whatever a user names one by.

    Args:
        tunnel: A ready `Tunnel`, taken as it is; a plan; a file; or None for the packaged tunnel.
        lining: The variant of the walls.
        piece: Start and length of the piece to cut out, m; None keeps the whole tunnel. A length beyond the tunnel's
            end is shortened to it.
        reach: Largest range that will be asked for, m.
    """
    if isinstance(tunnel, Tunnel):
        if tunnel.reach < reach:
            raise ValueError(f"the tunnel was made for ranges up to {tunnel.reach} m, got range_max={reach}")
        return tunnel
    plan = tunnel if isinstance(tunnel, TunnelPlan) else load_tunnel(tunnel)
    if piece is not None:
        start, length = piece
        plan = plan.slice(start, min(length, plan.length - start))
    return Tunnel.from_plan(plan, lining, reach=reach)
