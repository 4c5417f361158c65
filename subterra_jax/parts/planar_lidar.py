"""The planar LiDAR as a part of an environment; `subterra_jax.lidar` casts its beams."""

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from subterra_jax import lidar
from subterra_jax.constants import SPATIAL_HEIGHT
from subterra_jax.host.texture import brightness, wall_angle
from subterra_jax.lidar3d import echo
from subterra_jax.parts.brightness import MOST, intensity, normal_beside, place_ends
from subterra_jax.parts.part import Bounds, Noise, Part, SensingState
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

    def observe(self, own: Any, sensing: SensingState, noise: Noise, params: EnvParams) -> dict[str, Array]:
        walls, n = self.true_ranges(own, sensing, params), params.lidar.n_beams
        directions = lidar.beam_directions(sensing.heading, n)
        things = sensing.hits(directions)
        ranges = sensing.corrupt(jnp.minimum(walls, things))
        entries = {"ranges": lidar.add_noise(ranges, noise.normal, params.lidar)}
        if params.lidar.intensity:
            tunnel, x, y = sensing.tunnel, directions[:, 0], directions[:, 1]
            ends = sensing.position[0] + walls * x, sensing.position[1] + walls * y
            *_, left, at, tangent_x, tangent_y = place_ends(tunnel, sensing.station, sensing.position, *ends)
            slant, factor = jnp.abs(tangent_x * y - tangent_y * x), 1.0
            if params.lidar.texture is not None:
                angle = wall_angle(jnp, left, SPATIAL_HEIGHT)
                factor = brightness(jnp, at, angle, tunnel.texture, params.lidar.texture)
            met = things < walls
            reflectivity = jnp.where(met, echo.ALBEDO_THING, echo.ALBEDO_LINING * factor)
            shown = intensity(jnp.where(met, 1.0, slant), reflectivity, normal_beside(noise.normal, 1))
            entries["intensity"] = jnp.where(ranges < params.lidar.range_max, shown, 0.0)
        return entries

    def true_ranges(self, own: Any, sensing: SensingState, params: EnvParams) -> Array:
        """Cast the beams against the walls, m."""
        return lidar.scan(
            sensing.tunnel, sensing.position, sensing.heading, sensing.station, params.lidar, sensing.needed
        )

    def space(self, params: EnvParams) -> dict[str, Bounds]:
        n_beams, range_max = params.lidar.n_beams, jnp.max(jnp.asarray(params.lidar.range_max))
        entries: dict[str, Bounds] = {"ranges": (np.zeros(n_beams), jnp.full(n_beams, range_max))}
        if params.lidar.intensity:
            entries["intensity"] = (np.zeros(n_beams), np.full(n_beams, MOST))
        return entries

    def skips_unneeded(self, params: EnvParams) -> bool:
        return lidar.skips_unneeded(params.lidar)
