"""Several tunnels in one: their nodes and blocks one after another, with padding between.

A step reads one window of blocks wherever it lies; what a stack costs is memory that no longer fits a cache: 7 % for
100 tunnels and 58 % for 1,000 on an H200, half as much again for 100 on a CPU.
"""

from collections.abc import Sequence

import jax
import numpy as np

from subterra_jax.tunnel.blocks import PADDING_CENTRE, PADDING_THICKNESS
from subterra_jax.tunnel.tunnel import Tunnel


def stack(tunnels: Sequence[Tunnel]) -> Tunnel:
    """One `Tunnel` of several; `pick(i)` gives the i-th.

    Windows are as large as the largest of any tunnel. Blocks half of a larger window apart are still further apart
    than `reach`, because the blocks of each tunnel are in order of station; and behind its last block each tunnel gets
    so much padding that no window, counted up to the next power of two, reaches the next tunnel.

    Args:
        tunnels: One or more single tunnels, of any length and lining.

    Returns:
        The stack, `reach` being the least of any; a tunnel alone is given back as it is.

    Raises:
        ValueError: There are none, or one is a stack itself.
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
    parts = [_padded(t, n_scan, n_contact, n_vertices) for t in tunnels]
    n_blocks, n_nodes = np.array([box.shape[1] for box, _ in parts]), np.array([t.grid.shape[0] for t in tunnels])
    first_block, first_node = (np.concatenate([[0], np.cumsum(n)[:-1]]).astype(np.int32) for n in (n_blocks, n_nodes))
    put = jax.device_put  # `jnp.asarray` would compile a program for each new shape
    numbers = lambda name: put(np.stack([np.asarray(getattr(t, name)) for t in tunnels]))  # noqa: E731
    shifted = lambda name: put(  # noqa: E731
        np.concatenate([np.asarray(getattr(t, name)) + b for t, b in zip(tunnels, first_block, strict=True)])
    )
    return Tunnel(
        length=numbers("length"),
        spacing=numbers("spacing"),
        ring_pitch=numbers("ring_pitch"),
        first_node=put(first_node),
        n_nodes=numbers("n_nodes"),
        grid=put(np.concatenate([np.asarray(t.grid) for t in tunnels])),
        scan_first=shifted("scan_first"),
        contact_first=shifted("contact_first"),
        box=put(np.concatenate([box for box, _ in parts], axis=1)),
        wall=put(np.concatenate([wall for _, wall in parts])),
        reach=min(t.reach for t in tunnels),
        n_scan=n_scan,
        n_contact=n_contact,
        n_candidates=max(t.n_candidates for t in tunnels),
    )


def _padded(tunnel: Tunnel, n_scan: int, n_contact: int, n_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """Box and wall of a tunnel with so much padding that none of its windows reaches beyond it."""
    box, wall = np.asarray(tunnel.box), np.asarray(tunnel.wall)
    # A beam that enters no box looks at the block whose number has all bits set.
    window = 1 << (n_scan - 1).bit_length()
    needed = max(
        int(np.asarray(tunnel.scan_first).max()) + window, int(np.asarray(tunnel.contact_first).max()) + n_contact
    )
    missing = max(0, needed - box.shape[1])
    fill = np.zeros((6, missing), np.float32)
    fill[:2], fill[4] = PADDING_CENTRE, PADDING_THICKNESS
    wall = np.pad(wall, ((0, 0), (0, 0), (0, n_vertices - wall.shape[2])), mode="edge")
    return np.concatenate([box, fill], axis=1), np.pad(wall, ((0, missing), (0, 0), (0, 0)))
