"""The planar LiDAR as a part of an environment; `subterra_jax.lidar` casts its beams."""

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from subterra_jax import lidar
from subterra_jax.parts.part import Bounds, Noise, Part, Sight
from subterra_jax.state import EnvParams


@dataclasses.dataclass(frozen=True)
class PlanarLidar(Part):
    """Ranges to walls and obstacles in the plane of the sensor, through faults, with noise."""

    name: ClassVar[str] = "lidar"
    place: ClassVar[int] = 0

    def defaults(self) -> dict[str, Any]:
        return {"lidar": lidar.LidarParams()}

    def normals(self, params: EnvParams) -> int:
        return params.lidar.n_beams

    def observe(self, own: Any, sight: Sight, noise: Noise, params: EnvParams) -> dict[str, Array]:
        ranges = self.true_ranges(own, sight, params)
        directions = lidar.beam_directions(sight.heading, params.lidar.n_beams)
        ranges = sight.spoil(jnp.minimum(ranges, sight.hits(directions)))
        return {"ranges": lidar.add_noise(ranges, noise.normal, params.lidar)}

    def true_ranges(self, own: Any, sight: Sight, params: EnvParams) -> Array:
        """Cast the beams against the walls, m."""
        return lidar.scan(sight.tunnel, sight.position, sight.heading, sight.station, params.lidar, sight.wanted)

    def space(self, params: EnvParams) -> dict[str, Bounds]:
        n_beams, range_max = params.lidar.n_beams, jnp.max(jnp.asarray(params.lidar.range_max))
        return {"ranges": (np.zeros(n_beams), jnp.full(n_beams, range_max))}

    def skips_unwanted(self, params: EnvParams) -> bool:
        return lidar.skips_unwanted(params.lidar)
