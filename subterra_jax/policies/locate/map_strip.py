"""The map as a learnt localiser gets it: the distance of either wall from the centreline along the station."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.baselines.wallmap import wall_map
from subterra_jax.policies.locate.profiles import BIN
from subterra_jax.tunnel import Tunnel

_FINE = 5  # cells of the wall map in one bin


@struct.dataclass
class MapStrip:
    """Walls of one tunnel, or of the tunnels of a stack one after another."""

    # distance of the left and of the right wall from the centreline in each bin of station, m
    wall: Float[Array, "2 all_bins"]
    first_bin: Int[Array, "*k"]  # first bin of each tunnel
    n_bins: Int[Array, "*k"]  # bins of each tunnel
    first_node: Int[Array, "*k"]  # first node of each tunnel in its stack, by which `pick` knows it

    def pick(self, index: Int[Array, ""]) -> "MapStrip":
        """Returns the strip of one tunnel by its number."""
        numbers = {name: getattr(self, name)[index] for name in ("first_bin", "n_bins", "first_node")}
        return dataclasses.replace(self, **numbers)

    def of(self, tunnel: Tunnel) -> "MapStrip":
        return self.pick(jnp.argmax(self.first_node == tunnel.first_node))

    def sample(self, start: Float[Array, ""], n: int) -> tuple[Float[Array, "2 n"], Bool[Array, "n"]]:
        """Returns both walls (m) at `n` stations, a bin apart, and whether each lies inside of the tunnel.

        Args:
            start: First station, m.
            n: Number of stations.
        """
        place = start / BIN - 0.5 + jnp.arange(n, dtype=jnp.float32)
        lower = jnp.floor(place)
        index, fraction = lower.astype(jnp.int32), place - lower
        cell = self.first_bin + jnp.clip(index, 0, self.n_bins - 2)
        wall = self.wall[:, cell] + fraction * (self.wall[:, cell + 1] - self.wall[:, cell])
        return wall, (index >= 0) & (index < self.n_bins - 1)


def walls_of(tunnel: Tunnel) -> Float[np.ndarray, "2 n"]:
    """Returns the walls of a single tunnel by bins, m; runs on the host."""
    wall = np.asarray(wall_map(tunnel, cell=BIN / _FINE).wall)
    n = wall.shape[1] // _FINE
    return wall[:, : n * _FINE].reshape(2, n, _FINE).mean(axis=2)


def join(walls: list[Float[np.ndarray, "2 n"]], tunnel: Tunnel) -> MapStrip:
    """Returns the strip of a tunnel or a stack.

    Args:
        walls: Of `walls_of`, one for each tunnel.
        tunnel: The tunnel or the stack.
    """
    n = np.array([wall.shape[1] for wall in walls], np.int32)
    whole: Any = np.concatenate(walls, axis=1).astype(np.float32)
    nodes = jnp.atleast_1d(jnp.asarray(tunnel.first_node))
    return MapStrip(jnp.asarray(whole), jnp.asarray(np.cumsum(n) - n, jnp.int32), jnp.asarray(n), nodes)


def map_strip(tunnel: Tunnel) -> MapStrip:
    """Returns the strip of a tunnel or a stack; runs on the host."""
    return join([walls_of(tunnel.pick(index)) for index in range(tunnel.count)], tunnel)
