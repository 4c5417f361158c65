"""Agents that tell by their speed what they were given: truth, ranges, map."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct


@struct.dataclass
class Probe:
    """Drives at 0.1 m/s, and faster by 0.1, 0.2 and 0.4 m/s where it gets the truth, ranges and the map."""

    uses_lidar: bool = struct.field(pytree_node=False, default=False)
    uses_map: bool = struct.field(pytree_node=False, default=False)
    privileged: bool = struct.field(pytree_node=False, default=False)
    name: str = struct.field(pytree_node=False, default="probe")

    def begin(self, key, obs, params):
        return self._gets(obs, params)

    def act(self, key, memory, obs, params, known):
        ranges, tunnel = jnp.maximum(memory, self._gets(obs, params))
        truth = 0.0 if known is None else 1.0
        speed = 0.1 * (1.0 + truth + 2.0 * ranges + 4.0 * tunnel)
        return jnp.stack([speed, 0.0, jnp.nan, 0.0, 0.0]), memory

    def _gets(self, obs: Any, params: Any) -> jax.Array:
        """Whether there are ranges, and whether there is a map, 1 or 0 each."""
        n_beams = params.lidar.n_beams
        ranges = jnp.isfinite(obs.ranges).any() | jnp.isfinite(obs.flat[:n_beams]).any()
        tunnel = params.tunnel
        shapes = jnp.isfinite(tunnel.grid).any() | jnp.isfinite(tunnel.box).any() | jnp.isfinite(tunnel.wall).any()
        return jnp.stack([ranges, shapes]).astype(jnp.float32)


PROBES = {
    "nothing": (Probe(), 0.1),
    "truth": (Probe(privileged=True), 0.2),
    "ranges": (Probe(uses_lidar=True), 0.3),
    "map": (Probe(uses_map=True), 0.5),
}
