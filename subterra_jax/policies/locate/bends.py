"""Curvature of the tunnel as the robot sees it, and points put where they are along the axis.

In a bend the outer wall is longer than the axis and the inner one shorter: at a radius of 100 m and a half width of
2.7 m by 2.7 %, which is more than the slip that is sought. So the curvature is followed from scan to scan by how far
the walls ahead and behind fall away to one side, and points are put at their station on the axis.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.steering import Corridor
from subterra_jax.policies.locate.profiles import Points, add_faces
from subterra_jax.policies.locate.strips import sense

_LENGTH = 4.0  # m of travel over which scans are averaged
_CLIP = 0.2  # m by which a point may at most speak against the curvature: niches and boxes are no bends
_MOST = 1.0 / 40.0  # 1/m; no tunnel here bends more
_LEAST = 50.0  # m⁴: points that are all beside the robot say nothing of a bend


def look(
    bend: Float[Array, ""], obs: Observed, walls: Corridor, moved: Float[Array, ""], params: Any
) -> tuple[Points, Float[Array, ""]]:
    """Returns the points of an observation along a straightened tunnel, and the curvature after it.

    Args:
        bend: Curvature before the observation, 1/m.
        obs: The observation.
        walls: The walls beside the robot.
        moved: Distance since the observation before, m.
        params: The task.
    """
    points = sense(obs, walls, params)
    bend = follow(bend, points, moved)
    return add_faces(straighten(points, walls, bend)), bend


def follow(bend: Float[Array, ""], points: Points, moved: Float[Array, ""]) -> Float[Array, ""]:
    """Returns the curvature after a scan, 1/m, positive to the left.

    Args:
        bend: Curvature before it.
        points: Points of the scan, as they were found.
        moved: Distance since the scan before, m.
    """
    away = 0.5 * points.along**2
    weight = points.seen.astype(jnp.float32)
    centred = _centred(away, weight, points.rays)
    error = _centred(_sign(points) * points.out - bend * away, weight, points.rays)
    size = jnp.sum(weight * centred**2)
    found = jnp.sum(weight * centred * jnp.clip(error, -_CLIP, _CLIP)) / jnp.maximum(size, _LEAST)
    gain = 1.0 - jnp.exp(-moved / _LENGTH)
    return jnp.clip(bend + gain * found, -_MOST, _MOST)


def straighten(points: Points, walls: Corridor, bend: Float[Array, ""]) -> Points:
    """Returns the points as they would be were the tunnel straight: distances along the axis, and beyond its walls.

    Args:
        points: Points as they were found.
        walls: The walls beside the robot.
        bend: Curvature, 1/m, positive to the left.
    """
    sign = _sign(points)
    left = points.out * sign + jnp.where(sign > 0.0, walls.left, -walls.right)
    along, away = points.along / (1.0 - bend * left), 0.5 * points.along**2
    along = along * (1.0 - (bend * along) ** 2 / 3.0)  # an angle from its tangent
    return dataclasses.replace(points, along=along, out=points.out - sign * bend * away)


def _sign(points: Points) -> Float[Array, "row 1"]:
    """Returns 1 for rows of points on the left and -1 for those on the right."""
    side = np.arange(points.seen.shape[-2]) // points.rays % 2
    return jnp.asarray(np.where(side == 0, 1.0, -1.0)[:, None], jnp.float32)


def _centred(values: Array, weight: Array, rays: int) -> Array:
    """Returns values less their mean on each side."""
    sides = lambda array: array.reshape(-1, rays * array.shape[-1])  # noqa: E731
    mean = jnp.sum(sides(values * weight), axis=1) / jnp.maximum(jnp.sum(sides(weight), axis=1), 1.0)
    return values - jnp.repeat(mean, rays)[:, None]
