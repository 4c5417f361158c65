"""What one scan says of rings: how far the side beams' ends lie behind two straight walls, and where along the axis.

Beams that fall short of both walls have hit something that stands in the tunnel. A fit to all beams takes them for wall
and so sees bumps where there are none; a careful one leaves them out.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

_NEAREST, _FARTHEST = 1.0, 4.5  # m to a wall; nearer is an obstacle, farther an opening or a mouth
_TOUCH, _ACROSS = 0.3, 6.0  # m; the same for who leaves obstacles out by themselves, and may drive along either wall
_CLIP = (-0.2, 0.3)  # m, of what one beam may say
_SHORT = 0.15  # m; a beam that ends so far before the walls of all others has not met them: three of its σ
_SHORT_MOST = 6  # beams that may be left out, of ten
_STEEPEST = math.sqrt(0.5)  # sine of the angle to the axis: flatter beams meet a wall where bends blur the place


class Bumps(NamedTuple):
    """Side beams, left and then right, from the front to the back.

    Attributes:
        bump: How far each beam's end lies behind its wall, m; 0 where the beam tells nothing.
        along: How far ahead of the robot it lies, m.
        valid: Whether the beam tells anything.
    """

    bump: Float[Array, "*env 2 side"]
    along: Float[Array, "*env 2 side"]
    valid: Bool[Array, "*env 2 side"]


def side_beams(n_beams: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Side beams `(2, m)`, left and then right, from the front to the back; their sine and cosine."""
    angle = np.arange(n_beams) * (2.0 * np.pi / n_beams)
    left = np.flatnonzero(np.sin(angle) > _STEEPEST - 1e-6)
    index = np.stack([left, (n_beams - left) % n_beams])
    return index, np.abs(np.sin(angle[index])).astype(np.float32), np.cos(angle[index]).astype(np.float32)


def plain(ranges: Float[Array, "*env n"]) -> Bumps:
    """By a fit to every beam, for a robot near the middle that faces along a free tunnel."""
    across, along = _ends(ranges)
    valid = (across > _NEAREST) & (across < _FARTHEST)
    off, _ = _fitted(across, along, valid)
    return Bumps(jnp.where(valid, jnp.clip(off, *_CLIP), 0.0), along, valid)


def careful(ranges: Float[Array, "*env n"]) -> Bumps:
    """By a fit without beams that fall short of the walls, for a robot that swerves round what stands in the tunnel.

    The shortest beam goes first and by itself: it bends the fit to all others most, so that some of them look short
    until it is gone. The fit's slope is the robot's angle to the axis; places and bumps are measured along and across
    the axis, not the robot.
    """
    across, along = _ends(ranges)
    valid = (across > _TOUCH) & (across < _ACROSS)
    for _ in range(_SHORT_MOST):
        off, _ = _fitted(across, along, valid)
        least = jnp.min(jnp.where(valid, off, 0.0), axis=(-2, -1), keepdims=True)
        valid = valid & ((off > least) | (least > -_SHORT))
    off, slope = _fitted(across, along, valid)
    shrink = 1.0 / jnp.sqrt(1.0 + slope * slope)
    ahead = (along + slope * across) * shrink
    return Bumps(jnp.where(valid, jnp.clip(off * shrink, *_CLIP), 0.0), ahead, valid)


def _ends(ranges: Float[Array, "*env n"]) -> tuple[Array, Array]:
    """Where side beams end: to the side and ahead of the robot, m."""
    index, sine, cosine = side_beams(ranges.shape[-1])
    distance = ranges[..., index]
    return distance * sine, distance * cosine


def _fitted(across: Array, along: Array, valid: Array) -> tuple[Array, Array]:
    """How far ends lie behind two parallel lines fitted to the valid ones, m; how fast each wall goes away ahead."""
    number = jnp.maximum(jnp.sum(valid, axis=-1, keepdims=True), 1)
    off = jnp.where(valid, across - jnp.sum(across * valid, axis=-1, keepdims=True) / number, 0.0)
    ahead = jnp.where(valid, along - jnp.sum(along * valid, axis=-1, keepdims=True) / number, 0.0)
    # Turned by a small angle, the left wall comes nearer with x and the right one goes away.
    signed = jnp.asarray([[1.0], [-1.0]])
    slope = jnp.sum(signed * off * ahead, axis=(-2, -1)) / (jnp.sum(ahead * ahead, axis=(-2, -1)) + 1e-3)
    return off - slope[..., None, None] * signed * ahead, slope[..., None, None] * signed
