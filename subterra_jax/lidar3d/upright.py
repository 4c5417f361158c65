"""The planar tunnel in three dimensions: its walls raised upright between a floor and a level crown."""

import numpy as np
from jaxtyping import Float

from subterra_jax.host.errors import TunnelError
from subterra_jax.lidar3d.surface import Axis, Triangles, join_surfaces
from subterra_jax.tunnel.plan import TunnelPlan

# Height of the crown above the ground, m, about that of the packaged bore. A plan holds none.
CROWN = 6.0
# Reach of floor and crown beyond the half width, behind pockets and niches, and of walls behind them, m.
_BEHIND, _OVERLAP = 1.0, 0.05


def raise_walls(plan: TunnelPlan, lining: str | None = None) -> tuple[Axis, Triangles]:
    """Return the axis and the triangles of a plan's walls raised upright, with a floor at its elevation and a crown.

    Level beams at the LiDAR's height meet what the planar LiDAR meets; pockets and furniture reach from floor to crown.

    Args:
        lining: Variant of its walls; `None` is `pockets`, or the first if there is none of that name.

    Raises:
        TunnelError: The plan does not have the lining, or its LiDAR is not below the crown.
    """
    if not plan.lidar_height < CROWN:
        raise TunnelError(f"the LiDAR must be below the assumed crown at {CROWN:g} m, is at {plan.lidar_height:g} m")
    walls = plan.lining(lining or plan.default_lining)
    parts = [_raised(wall.vertex[:-1], wall.vertex[1:], plan) for wall in (walls.left, walls.right)]
    parts.append(_raised(walls.furniture[:, :2], walls.furniture[:, 2:], plan))
    normal = np.stack([-plan.tangent[:, 1], plan.tangent[:, 0]], axis=-1)
    reach = (plan.half_width + _BEHIND)[:, None] * normal
    for height in (0.0, CROWN):
        z = (plan.elevation + height)[:, None]
        left, right = np.hstack([plan.centre + reach, z]), np.hstack([plan.centre - reach, z])
        parts.append(_strips(left[:-1], left[1:], right[:-1], right[1:]))
    position = np.column_stack([plan.centre, plan.elevation + 0.5 * CROWN])
    tangent = np.column_stack([plan.tangent, np.gradient(plan.elevation, plan.station)])
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return Axis(plan.station, position, tangent), join_surfaces(parts)


def _raised(start: Float[np.ndarray, "n 2"], end: Float[np.ndarray, "n 2"], plan: TunnelPlan) -> Triangles:
    """Return segments of wall raised from a little below the floor to a little above the crown."""
    from scipy.spatial import KDTree  # half a second to import, and planar tasks do not need it

    nearest = KDTree(plan.centre)
    corners = []
    for point in (start, end):
        floor = plan.elevation[nearest.query(point)[1]] if len(point) else np.zeros(0)
        corners += [np.column_stack([point, floor - _OVERLAP]), np.column_stack([point, floor + CROWN + _OVERLAP])]
    low_start, high_start, low_end, high_end = corners
    return _strips(low_start, low_end, high_start, high_end)


def _strips(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> Triangles:
    """Return two triangles between each four corners, of which `a` and `b` face `c` and `d`."""
    n = len(a)
    i = np.arange(n)
    faces = np.concatenate([np.column_stack([i, i + n, i + 2 * n]), np.column_stack([i + n, i + 3 * n, i + 2 * n])])
    return Triangles(np.concatenate([a, b, c, d]).reshape(-1, 3), faces)
