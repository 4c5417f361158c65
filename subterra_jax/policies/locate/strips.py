"""Points of a spinning LiDAR on strips of the wall: a strip is the wall of one side at one height above the sensor.

A planar scan sees one strip of either wall. Rings above and below see further ones, and more columns see each place
more often; all strips go through the same front end.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import LIDAR_ENTRIES, Observed, level_intensity
from subterra_jax.baselines.steering import Corridor
from subterra_jax.lidar3d.beams import N_LEVEL
from subterra_jax.policies.locate.profiles import ECHO, N_BEARINGS, OUT, REACH, Points, find_points, log_brightness

# m above the sensor: where rings of ± 1, 3 and 5° meet a wall 2.7 m away, 22.5° from ahead.
HEIGHTS = (0.12, -0.12, 0.37, -0.37, 0.62, -0.62)
RAYS = 2  # columns that each bearing takes in
_OFF = 0.15  # m by which a return may be off a strip's height: rings are 0.25 m apart where beams look far ahead


def sense(obs: Observed, walls: Corridor, params: Any) -> Points:
    """Returns the points of an observation on the walls: of level ranges, or of an image of rings and columns."""
    if not is_spinning(params.lidar):
        return find_points(obs.ranges, walls, params.lidar.range_max, level_intensity(obs, params))
    entries = {name: obs.entries[name].reshape(params.lidar.shape) for name in LIDAR_ENTRIES & set(obs.entries)}
    return _find_strips(entries["scan"], walls, params.lidar, entries.get("intensity"))


def n_sides(lidar: Any) -> int:
    """Returns the number of sides that the points of a LiDAR are of."""
    return (2 * len(HEIGHTS) if is_spinning(lidar) else 2) * (1 + lidar.intensity)


def is_spinning(lidar: Any) -> bool:
    """Tells whether a LiDAR gives an image of rings, with columns for every bearing."""
    rings, columns = getattr(lidar, "shape", (1, 1))
    return rings > 1 and columns % N_LEVEL == 0 and columns // N_LEVEL >= RAYS


def _find_strips(
    image: Float[Array, "ring column"],
    walls: Corridor,
    sensor: Any,
    intensity: Float[Array, "ring column"] | None = None,
) -> Points:
    """Returns the return of the ring that looks nearest to each strip's height, by bearing and column."""
    n_rings, n_columns = image.shape
    direction = jnp.asarray(sensor.directions).reshape(n_rings, n_columns, 3)
    elevation = jnp.arcsin(direction[:, 0, 2])
    azimuth = jnp.arctan2(direction[0, :, 1], direction[0, :, 0])
    every = n_columns // N_LEVEL
    left = every * np.arange(1, N_BEARINGS + 1) + (np.arange(RAYS) * (every // RAYS))[:, None]
    column = np.stack([left, n_columns - left])  # (side, ray, bearing)
    wall = jnp.stack([walls.left, walls.right])[:, None, None]
    angle = azimuth[column] + walls.angle
    sine = jnp.abs(jnp.sin(angle))
    height = jnp.asarray(HEIGHTS)[:, None, None, None]
    needed = jnp.arctan(height * sine / jnp.maximum(wall, 0.5))
    ring = jnp.argmin(jnp.abs(needed[..., None] - elevation), axis=-1)
    reach = image[ring, column]
    level = reach * jnp.cos(elevation[ring])
    along, out = level * jnp.cos(angle), level * sine - wall
    seen = (reach < sensor.range_max - ECHO) & (jnp.abs(along) < REACH) & (jnp.abs(out) < OUT)
    seen &= jnp.abs(reach * jnp.sin(elevation[ring]) - height) < _OFF
    rows = lambda values: values.reshape(-1, N_BEARINGS)  # noqa: E731
    face = None
    if intensity is not None:
        incidence = sine * jnp.cos(elevation[ring])
        face = rows(log_brightness(intensity[ring, column], incidence, sensor.full_scale))
    return Points(rows(along), rows(out), rows(seen), RAYS, face)
