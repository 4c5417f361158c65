"""Profiles of the walls, one for each beam, over the commanded distance at which a point would be beside the robot."""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.baselines.steering import Corridor
from subterra_jax.lidar import bearings
from subterra_jax.lidar3d.echo import ALBEDO_LINING
from subterra_jax.parts.brightness import FULL_SCALE

BIN = 0.1  # m of a profile's bin
BLOCK = 10  # bins of a block, over which evidence is summed
REACH = 9.5  # m ahead or behind; points further away are left out
WINDOW = 288  # bins that a robot keeps
N_BEARINGS = 7  # on either side: of 16 beams, those that are neither ahead nor behind
ECHO = 1e-3  # m below `range_max`: no echo
OUT = 1.5  # m; points further from the tracked wall than this are not of the wall
_FACE = 0.1  # m of relief for a brightness of e: both channels are of one order
_SPREAD = 2.0  # bins to either side over which a point counts, with falling weight

Grid = Float[Array, "side 7 bins"]


@struct.dataclass
class Points:
    """Points that a scan found on the walls, by side (left, right) and bearing (from ahead to behind).

    Of a LiDAR in three dimensions there are further sides, left and right at other heights (`strips`), and `rays` rows
    of points for each.
    """

    along: Float[Array, "row 7"]  # distance ahead, m
    out: Float[Array, "row 7"]  # distance beyond the tracked wall, m
    seen: Bool[Array, "row 7"]  # true where there is a point
    rays: int = struct.field(pytree_node=False, default=1)  # rows of points that belong to one side
    face: Float[Array, "row 7"] | None = None  # logarithm of the brightness, about that of a bare lining

    @property
    def n_sides(self) -> int:
        return self.seen.shape[-2] // self.rays


@struct.dataclass
class Profiles:
    """Weighted sums of points by bin."""

    weight: Grid  # sum of weights
    out: Grid  # weighted sum of distances beyond the wall, m
    along: Grid  # weighted sum of distances ahead at which they were seen, m


def log_brightness(intensity: Array, incidence: Array, full_scale: float = FULL_SCALE) -> Array:
    """Returns the logarithm of how bright the wall is beside a bare lining, from intensity and cosine of incidence."""
    return jnp.log(jnp.maximum(intensity, 1.0) / (full_scale * ALBEDO_LINING * jnp.maximum(incidence, 0.05)))


def add_faces(points: Points) -> Points:
    """Returns points with brightness as further sides of the wall, which the same front end matches."""
    if points.face is None:
        return points
    twice = lambda one, two: jnp.concatenate([one, two], axis=-2)  # noqa: E731
    out, along = twice(points.out, _FACE * points.face), twice(points.along, points.along)
    return Points(along, out, twice(points.seen, points.seen), points.rays)


def find_points(
    ranges: Float[Array, "n_beams"],
    walls: Corridor,
    range_max: Float[Array, ""] | float,
    intensity: Float[Array, "n_beams"] | None = None,
) -> Points:
    """Returns the points of a scan on either wall; of more than 16 beams, those at the bearings of 16."""
    n, every = ranges.shape[0], ranges.shape[0] // 16
    left = every * np.arange(1, N_BEARINGS + 1)
    chosen = np.stack([left, n - left])
    angle = jnp.asarray(bearings(n)[chosen], jnp.float32) + walls.angle
    reach = ranges[chosen]
    along, across = reach * jnp.cos(angle), reach * jnp.abs(jnp.sin(angle))
    out = across - jnp.stack([walls.left, walls.right])[:, None]
    seen = (reach < range_max - ECHO) & (jnp.abs(along) < REACH) & (jnp.abs(out) < OUT)
    face = None if intensity is None else log_brightness(intensity[chosen], jnp.abs(jnp.sin(angle)))
    return Points(along, out, seen, face=face)


def blank(n_bins: int, n_sides: int) -> Profiles:
    """Returns profiles without a point."""
    return Profiles(*(jnp.zeros((n_sides, N_BEARINGS, n_bins)) for _ in range(3)))


def add_points(profiles: Profiles, points: Points, bins: Float[Array, "*t row 7"], wrapped: bool = False) -> Profiles:
    """Adds points, of one scan or of many.

    Args:
        profiles: Profiles so far.
        points: Points; their fields may have leading axes.
        bins: Place of each point, in bins.
        wrapped: Bins beyond the end begin anew; otherwise points there are left out.
    """
    n_bins = profiles.weight.shape[-1]
    first = jnp.floor(bins).astype(jnp.int32)
    index = first[..., None] + np.arange(-1, 3)
    weight = jnp.maximum(1.0 - jnp.abs(index - bins[..., None]) / _SPREAD, 0.0) * points.seen[..., None]
    inside = (index >= 0) & (index < n_bins) if not wrapped else jnp.ones_like(index, bool)
    weight, index = jnp.where(inside, weight, 0.0), jnp.mod(index, n_bins)
    side = (np.arange(points.seen.shape[-2]) // points.rays)[:, None, None]
    beam = np.arange(N_BEARINGS)[None, :, None]

    def add(sums: Grid, values: Array) -> Grid:
        return sums.at[side, beam, index].add(weight * values)

    one = jnp.ones(())
    return Profiles(
        add(profiles.weight, one),
        add(profiles.out, points.out[..., None]),
        add(profiles.along, points.along[..., None]),
    )


def forget(profiles: Profiles, before: Int[Array, ""], now: Int[Array, ""]) -> Profiles:
    """Empties the bins of a wrapped window that the robot's newest bin has come to since `before`."""
    n_bins = profiles.weight.shape[-1]
    index = jnp.arange(n_bins)
    newest = lambda at: at - jnp.mod(at - index, n_bins)  # noqa: E731
    kept = newest(now) == newest(before)
    return Profiles(*(jnp.where(kept, sums, 0.0) for sums in (profiles.weight, profiles.out, profiles.along)))


def cut(profiles: Profiles, first: Int[Array, ""], n: int) -> Profiles:
    """Returns `n` bins of wrapped profiles, from bin `first` on."""
    index = jnp.mod(first + jnp.arange(n), profiles.weight.shape[-1])
    return Profiles(*(sums[..., index] for sums in (profiles.weight, profiles.out, profiles.along)))


def mean_along(profiles: Profiles) -> Float[Array, "side 7"]:
    """Returns the mean distance ahead at which the points were seen, m; 0 where there are none."""
    total = jnp.sum(profiles.weight, axis=-1)
    return jnp.sum(profiles.along, axis=-1) / jnp.maximum(total, 1e-3)
