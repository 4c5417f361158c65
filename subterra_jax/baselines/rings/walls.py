"""Two walls fitted to the side beams of one scan after the other, so that what stands out of them can be heard.

The walls are tracked: distance of each, slope of both against the heading, and their bend. Where another pair of walls
has more beams on it than the tracked one, as at the start, after a turn or after a dropout, it is taken over. Beams
that fall short (dust, boxes) or see nothing do not count.
"""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

_NEAREST, _FARTHEST = 1.0, 4.5  # m to a wall; nearer is an obstacle, farther an opening or a mouth
_SHORT, _LONG = -0.15, 0.35  # m against the fitted wall, within which a beam has met it or a pocket in it
_STEEPEST = math.sqrt(0.5)  # sine of the angle to the axis: flatter beams meet a wall where bends blur the place
_MOST_BEAMS = 9  # a side; of more, some are left out
_RANGE_SIGMA, _FIT_SIGMA = 0.05, 0.02  # m, of a range and of the fit
_SLOPES = np.linspace(-0.15, 0.15, 11).astype(np.float32)  # against the tracked one: a step turns by at most 0.15 rad
_STEEP = 0.3  # slope beyond which the walls are not tracked: the robot is turning round
_ON_WALL, _TRACKED = 0.09, 0.1  # m, how near a beam or the tracked wall has to be to count for a candidate
_MORE = 0.7  # beams by which another pair of walls must be better
_REDESCEND = 0.12  # m, beyond which a residual loses its weight
_KEEP, _KEEP_SLOPE, _KEEP_BEND = 4.0, 4.0, 600.0  # how much the tracked values weigh, beams, m² and m⁴
_SHARPEST = 0.03  # 1/m
_SETTLED = 3.0  # scans
_USUAL = 0.01  # of what a beam sees all the time, per 0.15 m
_CLIP = (-0.2, 0.3)  # m, of what one beam may say


@struct.dataclass
class Walls:
    """The walls as tracked.

    Attributes:
        distance: Distance of each wall, m; left first.
        slope: Slope of both against the heading, 1.
        bend: Their curvature, 1/m.
        scans: How many scans they were seen in.
        usual: What each side beam sees on average beyond them, m.
    """

    distance: Float[Array, "*env 2"]
    slope: Float[Array, "*env"]
    bend: Float[Array, "*env"]
    scans: Float[Array, "*env"]
    usual: Float[Array, "*env 2 side"]


@struct.dataclass
class Bumps:
    """What a scan shows of the walls' relief.

    Attributes:
        height: How far each side beam goes beyond the wall and the usual, m; 0 where it does not count.
        along: How far ahead it ends, m.
        valid: Whether it counts.
    """

    height: Float[Array, "*env 2 side"]
    along: Float[Array, "*env 2 side"]
    valid: Bool[Array, "*env 2 side"]


def start(batch: tuple[int, ...], n_beams: int) -> Walls:
    """No wall seen yet."""
    zero, side = jnp.zeros(batch), side_beams(n_beams)[0].shape[1]
    return Walls(jnp.zeros((*batch, 2)), zero, zero, zero, jnp.zeros((*batch, 2, side)))


def side_beams(n_beams: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Side beams `(2, m)`, left and then right, from the front to the back; their sine and cosine."""
    angle = np.arange(n_beams) * (2.0 * np.pi / n_beams)
    left = np.flatnonzero(np.sin(angle) > _STEEPEST - 1e-6)
    left = left[:: max(1, math.ceil(len(left) / _MOST_BEAMS))]
    index = np.stack([left, (n_beams - left) % n_beams])
    return index, np.abs(np.sin(angle[index])).astype(np.float32), np.cos(angle[index]).astype(np.float32)


def height_variance(n_beams: int, model_sigma: float) -> Float[np.ndarray, "2 side"]:
    """Variance of a height, m²: the noise of the range across the wall, and what a model of the relief leaves out."""
    return np.square(_RANGE_SIGMA * side_beams(n_beams)[1]) + np.float32(model_sigma**2)


def look(walls: Walls, ranges: Float[Array, "*env n_beams"], share: Float[Array, "*env"]) -> tuple[Walls, Bumps]:
    """The walls after a scan, and what stands out of them.

    Args:
        walls: Before.
        ranges: The scan, m, the first beam straight ahead, the others counter-clockwise.
        share: Distance driven since the last scan, in units of 0.15 m, at most 2.
    """
    index, sine, cosine = side_beams(ranges.shape[-1])
    across, along = ranges[..., index] * sine, ranges[..., index] * cosine
    precision = 1.0 / height_variance(ranges.shape[-1], _FIT_SIGMA)
    usable = (across > _NEAREST) & (across < _FARTHEST)
    weight = jnp.where(usable, precision * (precision.size / max(float(np.sum(precision)), 1.0)), 0.0)
    chosen, loose = _chosen(walls, across, along, weight)
    fitted = _fitted(chosen, loose, across, along, weight)
    height = across - _wall(fitted, along)
    seen = (weight > 0.0) & (jnp.abs(fitted.slope) < _STEEP)[..., None, None]
    valid = seen & (height > _SHORT) & (height < _LONG)
    usual = walls.usual + _USUAL * share[..., None, None] * jnp.where(valid, height - walls.usual, 0.0)
    scans = walls.scans + jnp.where(jnp.sum(valid, axis=(-2, -1)) >= 3, 1.0, 0.0)
    height = jnp.where(valid, jnp.clip(height - walls.usual, *_CLIP), 0.0)
    return Walls(fitted.distance, fitted.slope, fitted.bend, scans, usual), Bumps(height, along, valid)


def _wall(walls: Walls, along: Float[Array, "*env 2 side"]) -> Float[Array, "*env 2 side"]:
    """Where the walls are beside the robot, m to the side."""
    slope, bend = walls.slope[..., None, None], walls.bend[..., None, None]
    return walls.distance[..., None] + _signed(slope + 0.5 * bend * along, along)


def _signed(factor: Array, along: Float[Array, "*env 2 side"]) -> Float[Array, "*env 2 side"]:
    """Turned to the left the left wall comes nearer ahead, and the right one goes away."""
    return jnp.asarray([[1.0], [-1.0]]) * factor * along


def _chosen(
    walls: Walls, across: Float[Array, "*env 2 side"], along: Float[Array, "*env 2 side"], weight: Array
) -> tuple[Walls, Bool[Array, "*env"]]:
    """The pair of walls that most beams lie on, and whether it is another than the tracked one.

    Candidates have one of several slopes and go through one of the beams, or are as far away as the tracked wall.
    """
    settled = jnp.minimum(walls.scans / _SETTLED, 1.0)
    slope = walls.slope[..., None] + _SLOPES
    bent = across - _signed(0.5 * walls.bend[..., None, None] * along, along)
    foot = bent[..., None, :, :] - _signed(slope[..., None, None], along[..., None, :, :])
    old = jnp.broadcast_to(walls.distance[..., None, :, None], (*foot.shape[:-1], 1))
    distance = jnp.concatenate([foot, old], axis=-1)
    near = _bell((distance[..., :, None] - foot[..., None, :]) / _ON_WALL)
    score = jnp.sum(weight[..., None, :, None, :] * near, axis=-1)
    score = score + settled[..., None, None, None] * _bell((distance - old) / _TRACKED)
    usable = jnp.concatenate([weight > 0.0, jnp.ones((*weight.shape[:-1], 1), bool)], axis=-1)
    score = jnp.where(usable[..., None, :, :], score, -1.0)
    best = jnp.argmax(score, axis=-1, keepdims=True)
    distance = jnp.take_along_axis(distance, best, axis=-1)[..., 0]
    pair = jnp.sum(jnp.max(score, axis=-1), axis=-1) - 0.5 * settled[..., None] * np.square(_SLOPES / 0.06)
    at = jnp.argmax(pair, axis=-1, keepdims=True)
    kept = jnp.sum(score[..., len(_SLOPES) // 2, :, -1], axis=-1)
    other = (jnp.max(pair, axis=-1) - kept > _MORE) | (walls.scans < 1.0)
    found = jnp.take_along_axis(distance, at[..., None], axis=-2)[..., 0, :]
    turned = jnp.clip(jnp.take_along_axis(slope, at, axis=-1)[..., 0], -2.0 * _STEEP, 2.0 * _STEEP)
    distance = jnp.where(other[..., None], found, walls.distance)
    return walls.replace(distance=distance, slope=jnp.where(other, turned, walls.slope)), other  # type: ignore[attr-defined]


def _bell(value: Array) -> Array:
    return jnp.exp(-0.5 * value * value)


def _fitted(walls: Walls, loose: Bool[Array, "*env"], across: Array, along: Array, weight: Array) -> Walls:
    """The walls by least squares whose weights redescend, drawn to where they were; one unknown after the other."""
    loose = loose | (walls.scans < _SETTLED)
    keep, keep_slope = jnp.where(loose, 0.3, _KEEP), jnp.where(loose, 0.5, _KEEP_SLOPE)
    row = _signed(jnp.ones_like(along), along)
    now = walls
    for _ in range(3):
        rest, trust = _rest(now, across, along, weight)
        pull = keep[..., None] * (walls.distance - now.distance)
        moved = (jnp.sum(trust * rest, axis=-1) + pull) / (jnp.sum(trust, axis=-1) + keep[..., None])
        now = dataclasses.replace(now, distance=now.distance + moved)
        rest, trust = _rest(now, across, along, weight)
        now = dataclasses.replace(now, slope=_drawn(walls.slope, now.slope, row, rest, trust, keep_slope))
        rest = across - _wall(now, along)
        bend = _drawn(walls.bend, now.bend, 0.5 * row * along, rest, trust, jnp.asarray(_KEEP_BEND))
        now = dataclasses.replace(now, bend=jnp.clip(bend, -_SHARPEST, _SHARPEST))
    return now


def _rest(walls: Walls, across: Array, along: Array, weight: Array) -> tuple[Array, Array]:
    """Residuals, m, and the weights that they leave."""
    rest = across - _wall(walls, along)
    return rest, weight / jnp.square(1.0 + jnp.square(rest / _REDESCEND))


def _drawn(before: Array, now: Array, row: Array, rest: Array, trust: Array, keep: Array) -> Array:
    """One unknown that both walls share, better by one step of least squares."""
    size = jnp.sum(trust * row * row, axis=(-2, -1)) + keep
    return now + (jnp.sum(trust * row * rest, axis=(-2, -1)) + keep * (before - now)) / size
