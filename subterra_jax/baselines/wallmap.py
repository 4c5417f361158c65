"""The map of a localiser: distance of either wall from the centreline at each station, and the centreline's curvature.

It is made once on the host, in float64, from the walls of the simulator. It is a pytree, so it can be data.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.blocks import PADDING_CENTRE

BEND_REACH = 6.0  # m over which the bend of the centreline is measured: as far as the most slanting useful beam reaches
_ROWS = 2048  # vertices looked up at once


@struct.dataclass
class WallMap:
    """Walls and centreline of one tunnel, or of the tunnels of a stack one after another."""

    # distance of the left and of the right wall from the centreline in each cell of station, m: the first surface going
    # outward, averaged over the blur of a range
    wall: Float[Array, "2 all_cells"]
    spread: Float[Array, "2 all_cells"]  # variance of that distance within the blur, m²: large where a pocket begins
    # curvature of the centreline ahead, behind and at each node, 1/m; positive to the left
    bend: Float[Array, "3 all_nodes"]
    half_width: Float[Array, ""]  # usual distance of a wall, m
    cell: Float[Array, ""]  # length of a cell of station, m
    # Length between nodes of the centreline, m. It and the next four are `(k,)` for a stack of k.
    spacing: Float[Array, "k"]
    first_cell: Int[Array, "k"]  # first cell of each tunnel
    n_cells: Int[Array, "k"]  # cells of each tunnel
    first_node: Int[Array, "k"]  # first node of each tunnel
    n_nodes: Int[Array, "k"]  # nodes of each tunnel

    def pick(self, tunnel: Tunnel) -> "WallMap":
        """Picks the map of one tunnel, found by its first node; fields of `(k,)` become scalars."""
        index = jnp.argmax(self.first_node == tunnel.first_node)
        names = ("spacing", "first_cell", "n_cells", "first_node", "n_nodes")
        return dataclasses.replace(self, **{name: getattr(self, name)[index] for name in names})

    def offset(
        self, station: Float[Array, "*n"], left: Bool[Array, "*n"]
    ) -> tuple[Float[Array, "*n"], Float[Array, "*n"], Bool[Array, "*n"]]:
        """Return the distance of a wall from the centreline (m), its variance (m²), and whether the station is inside.

        A station beyond a mouth gives the last cell and False.
        """
        index = jnp.floor(station / self.cell).astype(jnp.int32)
        cell = self.first_cell + jnp.clip(index, 0, self.n_cells - 1)
        entry = cell + jnp.where(left, 0, self.wall.shape[1])
        inside = (index >= 0) & (index < self.n_cells)
        return self.wall.reshape(-1)[entry], self.spread.reshape(-1)[entry], inside

    def curvature(self, station: Float[Array, "*n"]) -> Float[Array, "3 *n"]:
        """Return the curvature ahead of a station, behind it and at it, 1/m."""
        node = jnp.clip(jnp.round(station / self.spacing).astype(jnp.int32), 0, self.n_nodes - 1)
        return self.bend[:, self.first_node + node]


def wall_map(tunnel: Tunnel, cell: float = 0.02, blur: float = 0.03) -> WallMap:
    """Makes the map of a tunnel.

    Args:
        tunnel: A tunnel or a stack.
        cell: Length of a cell, m.
        blur: Standard deviation of an echo's position along the tunnel, m: about that of a range.
    """
    parts = [_map_tunnel(tunnel, index, cell, blur) for index in range(tunnel.count)]
    wall, spread, bend = (np.concatenate([part[i] for part in parts], axis=1) for i in range(3))
    n_cells, n_nodes = (np.array([part[i].shape[1] for part in parts], np.int32) for i in (0, 2))
    return WallMap(
        wall=jnp.asarray(wall, jnp.float32),
        spread=jnp.asarray(spread, jnp.float32),
        bend=jnp.asarray(bend, jnp.float32),
        half_width=jnp.float32(np.median(wall)),
        cell=jnp.float32(cell),
        spacing=jnp.atleast_1d(jnp.asarray(tunnel.spacing)),
        first_cell=jnp.asarray(np.cumsum(n_cells) - n_cells, jnp.int32),
        n_cells=jnp.asarray(n_cells),
        first_node=jnp.atleast_1d(jnp.asarray(tunnel.first_node)),
        n_nodes=jnp.asarray(n_nodes),
    )


def _map_tunnel(tunnel: Tunnel, index: int, cell: float, blur: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Wall `(2, n_cells)`, spread `(2, n_cells)` and bend `(3, n_nodes)` of one tunnel."""
    here = tunnel.pick(index)
    first, spacing = int(here.first_node), float(here.spacing)
    rows = slice(first, first + int(here.n_nodes))
    grid = np.asarray(tunnel.grid, np.float64)[rows]
    n_cells = max(1, int(np.ceil(spacing * (len(grid) - 1) / cell - 1e-6)))
    station, lateral = _tunnel_coordinates(_segments(tunnel, rows), grid, spacing)
    sides = (lateral.mean(axis=1) > 0.0, lateral.mean(axis=1) <= 0.0)
    profile = np.stack([_profile(station[side], np.abs(lateral[side]), n_cells, cell) for side in sides])
    mean = np.stack([_blur(row, blur / cell) for row in profile])
    # About the mean first, or a variance of cm² would be lost in squares of m.
    spread = np.stack([_blur((row - row.mean()) ** 2, blur / cell) for row in profile])
    spread = np.maximum(spread - (mean - profile.mean(axis=1, keepdims=True)) ** 2, 0.0)
    return mean, spread, _bend(grid, spacing)


def _segments(tunnel: Tunnel, rows: slice) -> np.ndarray:
    """Wall segments in the windows of some nodes, tunnel frame, m, `(n, 2, 2)`."""
    # In a stack each tunnel lies near its own origin: only the windows show to which tunnel a block belongs.
    first = np.asarray(tunnel.scan_first)[rows]
    blocks = slice(int(first.min()), int(first.max()) + tunnel.n_scan)
    box, wall = np.asarray(tunnel.box, np.float64)[:, blocks], np.asarray(tunnel.wall, np.float64)[blocks]
    real = (box[4] >= 0.0) & np.all(np.abs(box[:2]) < 0.5 * PADDING_CENTRE, axis=0)
    vertex = (wall + box[:2].T[:, :, None])[real].swapaxes(1, 2)
    segment = np.stack([vertex[:, :-1], vertex[:, 1:]], axis=2).reshape(-1, 2, 2)
    return segment[np.any(segment[:, 0] != segment[:, 1], axis=1)]


def _tunnel_coordinates(segment: np.ndarray, grid: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Station and lateral offset (m) of both ends of segments, each `(n, 2)`."""
    points = segment.reshape(-1, 2)
    station = np.concatenate([_nearest(points[i : i + _ROWS], grid) for i in range(0, len(points), _ROWS)]) * spacing
    for _ in range(3):
        position = station / spacing
        index = np.clip(np.floor(position).astype(int), 0, len(grid) - 2)
        row = grid[index] + (position - index)[:, None] * (grid[index + 1] - grid[index])
        from_x, from_y = points[:, 0] - row[:, 0], points[:, 1] - row[:, 1]
        lateral = row[:, 2] * from_y - row[:, 3] * from_x
        station = station + row[:, 2] * from_x + row[:, 3] * from_y
    return station.reshape(-1, 2), lateral.reshape(-1, 2)


def _nearest(points: np.ndarray, grid: np.ndarray) -> np.ndarray:
    squared = (points[:, None, 0] - grid[None, :, 0]) ** 2 + (points[:, None, 1] - grid[None, :, 1]) ** 2
    return np.argmin(squared, axis=1)


def _profile(station: np.ndarray, offset: np.ndarray, n_cells: int, cell: float) -> np.ndarray:
    """The first surface outward of the centreline at the middle of each cell, m, `(n_cells,)`."""
    order = np.argsort(station, axis=1)
    station, offset = np.take_along_axis(station, order, 1), np.take_along_axis(offset, order, 1)
    first = np.maximum(np.ceil(station[:, 0] / cell - 0.5).astype(int), 0)
    last = np.minimum(np.ceil(station[:, 1] / cell - 0.5).astype(int), n_cells)
    count = np.maximum(last - first, 0)
    row = np.repeat(np.arange(len(count)), count)
    middle = first[row] + np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    fraction = ((middle + 0.5) * cell - station[row, 0]) / (station[row, 1] - station[row, 0])
    profile = np.full(n_cells, np.inf)
    np.minimum.at(profile, middle, offset[row, 0] + fraction * (offset[row, 1] - offset[row, 0]))
    known = np.flatnonzero(np.isfinite(profile))
    return np.interp(np.arange(n_cells), known, profile[known])


def _blur(values: np.ndarray, sigma: float) -> np.ndarray:
    """Values averaged with a normal weight of `sigma` cells."""
    reach = int(np.ceil(3.0 * sigma))
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-9)) ** 2)
    return np.convolve(np.pad(values, reach, mode="edge"), weight / weight.sum(), mode="valid")


def _bend(grid: np.ndarray, spacing: float) -> np.ndarray:
    """Curvature of the circle through a node, tangent there, and the axis 6 m ahead or behind; and at it; 1/m."""
    angle = np.unwrap(np.arctan2(grid[:, 3], grid[:, 2]))
    step = max(1, round(BEND_REACH / spacing))
    index = np.arange(len(grid))
    rows = []
    for other in (np.minimum(index + step, len(grid) - 1), np.maximum(index - step, 0)):
        from_x, from_y = grid[other, 0] - grid[:, 0], grid[other, 1] - grid[:, 1]
        lateral = grid[:, 2] * from_y - grid[:, 3] * from_x
        rows.append(2.0 * lateral / np.maximum(from_x**2 + from_y**2, spacing**2))
    smooth = _blur(np.gradient(angle, spacing), 1.0 / spacing)
    return np.stack([*rows, smooth])
