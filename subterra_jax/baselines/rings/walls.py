"""Walls and their relief from the side beams of a scan: ring counters compare it with the pattern of the rings.

Ring joints and pockets stand out of two smooth walls. `track_walls` follows distance, slope and bend of the walls from
scan to scan. Where another pair of walls has more beams on it than the tracked one, as at the start, after a turn or
after a dropout, it takes over. Beams that fall short (dust, boxes) or get no echo are not used.
"""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

_NEAREST, _FARTHEST = 1.0, 4.5  # m to a wall; nearer is an obstacle, farther an opening or a mouth
_STEEPEST = math.sqrt(0.5)  # sine of the angle to the axis: flatter beams meet a wall where bends blur the position
_CLIP = (-0.2, 0.3)  # m, largest relief of one beam

_SHORT, _LONG = -0.15, 0.35  # m against the fitted wall, within which a beam has met it or a pocket in it
_MOST_BEAMS = 9  # a side; of more, some are left out
_RANGE_SIGMA, _FIT_SIGMA = 0.05, 0.02  # m, of a range and of the fit
_SLOPES = np.linspace(-0.15, 0.15, 11).astype(np.float32)  # against the tracked one: a step turns by at most 0.15 rad
_STEEP = 0.3  # slope beyond which the walls are not tracked: the robot is turning round
_ON_WALL, _TRACKED = 0.09, 0.1  # m, distance at which a beam or the tracked wall supports a candidate
_MORE = 0.7  # beams by which another pair of walls must be better
_REDESCEND = 0.12  # m, beyond which a residual loses its weight
_KEEP, _KEEP_SLOPE, _KEEP_BEND = 4.0, 4.0, 600.0  # weights of the tracked values: beams, m² and m⁴
_SHARPEST = 0.03  # largest bend, 1/m
_SETTLED = 3.0  # scans
_USUAL = 0.01  # gain of the usual distance beyond the walls, per usual step of 0.2 m


@struct.dataclass
class Walls:
    """The tracked walls."""

    distance: Float[Array, "2"]  # distance of each wall, m; left first
    slope: Float[Array, ""]  # slope of both walls against the heading, 1
    bend: Float[Array, ""]  # curvature of both walls, 1/m
    scans: Float[Array, ""]  # number of scans in which they were seen
    usual: Float[Array, "2 side"]  # average distance of each side beam's end beyond the walls, m

    def at(self, along: Float[Array, "2 side"]) -> Float[Array, "2 side"]:
        """Return the distance of each wall at distances ahead, m."""
        return self.distance[:, None] + _SIGN * (self.slope + 0.5 * self.bend * along) * along


# Turned left, the left wall comes nearer ahead and the right one recedes.
_SIGN = np.array([[1.0], [-1.0]], np.float32)


@struct.dataclass
class Bumps:
    """Relief of the walls in one scan: side beams, left and then right, from the front to the back."""

    # Distance of each beam's end beyond the wall, m; 0 where the beam is not used. In a tracked scan, also less the
    # usual.
    height: Float[Array, "2 side"]
    along: Float[Array, "2 side"]  # distance of its end ahead of the robot, m
    valid: Bool[Array, "2 side"]  # whether the beam is used


def begin_walls(n_beams: int) -> Walls:
    """Return the walls before any scan."""
    zero = jnp.zeros(())
    return Walls(jnp.zeros(2), zero, zero, zero, jnp.zeros(side_beams(n_beams)[0].shape))


def side_beams(n_beams: int, most: int = _MOST_BEAMS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return at most `most` beams a side, `(2, m)`: left and right, front to back; with their sines and cosines."""
    angle = np.arange(n_beams) * (2.0 * np.pi / n_beams)
    left = np.flatnonzero(np.sin(angle) > _STEEPEST - 1e-6)
    left = left[:: max(1, math.ceil(len(left) / most))]
    index = np.stack([left, (n_beams - left) % n_beams])
    return index, np.abs(np.sin(angle[index])).astype(np.float32), np.cos(angle[index]).astype(np.float32)


def height_variance(n_beams: int, model_sigma: float) -> Float[np.ndarray, "2 side"]:
    """Return the variance of a height, m²: noise of the range across the wall, and error of the relief model."""
    return np.square(_RANGE_SIGMA * side_beams(n_beams)[1]) + np.float32(model_sigma**2)


def track_walls(walls: Walls, ranges: Float[Array, "n_beams"], share: Float[Array, ""]) -> tuple[Walls, Bumps]:
    """Track the walls through a scan, and measure their relief.

    Args:
        walls: Walls before the scan.
        ranges: The scan, m, the first beam straight ahead, the others counter-clockwise.
        share: Distance driven since the last scan, in usual steps of 0.2 m, at most 2.
    """
    index, sine, cosine = side_beams(ranges.shape[0])
    across, along = ranges[index] * sine, ranges[index] * cosine
    precision = 1.0 / height_variance(ranges.shape[0], _FIT_SIGMA)
    usable = (across > _NEAREST) & (across < _FARTHEST)
    weight = jnp.where(usable, precision * (precision.size / max(float(np.sum(precision)), 1.0)), 0.0)
    pair, loose = _choose_pair(walls, across, along, weight)
    fitted = _fit_pair(pair, loose, across, along, weight)
    height = across - fitted.at(along)
    valid = (weight > 0.0) & (jnp.abs(fitted.slope) < _STEEP) & (height > _SHORT) & (height < _LONG)
    usual = walls.usual + _USUAL * share * jnp.where(valid, height - walls.usual, 0.0)
    scans = walls.scans + jnp.where(jnp.sum(valid) >= 3, 1.0, 0.0)
    height = jnp.where(valid, jnp.clip(height - walls.usual, *_CLIP), 0.0)
    return dataclasses.replace(fitted, scans=scans, usual=usual), Bumps(height, along, valid)


def _choose_pair(
    walls: Walls, across: Float[Array, "2 side"], along: Float[Array, "2 side"], weight: Float[Array, "2 side"]
) -> tuple[Walls, Bool[Array, ""]]:
    """The pair of walls with most beams on it, and whether it differs from the tracked one.

    Candidates have one of several slopes, and pass through the end of a beam or at the distance of the tracked wall.
    """
    settled = jnp.minimum(walls.scans / _SETTLED, 1.0)
    slope = walls.slope + _SLOPES
    bent = across - _SIGN * 0.5 * walls.bend * along * along
    foot = bent - slope[:, None, None] * _SIGN * along
    old = jnp.broadcast_to(walls.distance[:, None], (len(_SLOPES), 2, 1))
    distance = jnp.concatenate([foot, old], axis=-1)
    near = _bell((distance[..., :, None] - foot[..., None, :]) / _ON_WALL)
    score = jnp.sum(weight[:, None, :] * near, axis=-1) + settled * _bell((distance - old) / _TRACKED)
    usable = jnp.concatenate([weight > 0.0, jnp.ones((2, 1), bool)], axis=-1)
    score = jnp.where(usable, score, -1.0)
    best = jnp.argmax(score, axis=-1, keepdims=True)
    distance = jnp.take_along_axis(distance, best, axis=-1)[..., 0]
    pair = jnp.sum(jnp.max(score, axis=-1), axis=-1) - 0.5 * settled * np.square(_SLOPES / 0.06)
    at = jnp.argmax(pair)
    kept = jnp.sum(score[len(_SLOPES) // 2, :, -1])
    other = (pair[at] - kept > _MORE) | (walls.scans < 1.0)
    found = jnp.clip(slope[at], -2.0 * _STEEP, 2.0 * _STEEP)
    choose = lambda new, now: jnp.where(other, new, now)  # noqa: E731
    chosen = dataclasses.replace(walls, distance=choose(distance[at], walls.distance), slope=choose(found, walls.slope))
    return chosen, other


def _bell(value: Array) -> Array:
    """Unscaled normal density."""
    return jnp.exp(-0.5 * value * value)


def _fit_pair(walls: Walls, loose: Bool[Array, ""], across: Array, along: Array, weight: Array) -> Walls:
    """Fit the walls by least squares, weights redescending, with the last walls as prior; one unknown at a time."""
    loose = loose | (walls.scans < _SETTLED)
    keep, keep_slope = jnp.where(loose, 0.3, _KEEP), jnp.where(loose, 0.5, _KEEP_SLOPE)
    row = along * _SIGN
    now = walls
    for _ in range(3):
        rest, trust = _residuals(now, across, along, weight)
        moved = jnp.sum(trust * rest, axis=-1) + keep * (walls.distance - now.distance)
        now = dataclasses.replace(now, distance=now.distance + moved / (jnp.sum(trust, axis=-1) + keep))
        rest, trust = _residuals(now, across, along, weight)
        now = dataclasses.replace(now, slope=_solve_shared(walls.slope, now.slope, row, rest, trust, keep_slope))
        rest = across - now.at(along)
        bend = _solve_shared(walls.bend, now.bend, 0.5 * row * along, rest, trust, jnp.asarray(_KEEP_BEND))
        now = dataclasses.replace(now, bend=jnp.clip(bend, -_SHARPEST, _SHARPEST))
    return now


def _residuals(walls: Walls, across: Array, along: Array, weight: Array) -> tuple[Array, Array]:
    """Residuals, m, and the redescending weights."""
    rest = across - walls.at(along)
    return rest, weight / jnp.square(1.0 + jnp.square(rest / _REDESCEND))


def _solve_shared(before: Array, now: Array, row: Array, rest: Array, trust: Array, keep: Array) -> Array:
    """One unknown shared by both walls, after one step of least squares."""
    size = jnp.sum(trust * row * row) + keep
    return now + (jnp.sum(trust * row * rest) + keep * (before - now)) / size
