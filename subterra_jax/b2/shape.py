"""Looks of the B2: rounded surfaces made in code from the maker's dimensions; physics knows nothing of them.

They are drawn after the maker's figures and collision shapes, see `constants.py`, and are no copy of its meshes: where
these say nothing, as of the curves of the covers, they are ours.
"""

import dataclasses
from collections.abc import Sequence
from functools import cache

import numpy as np
from jaxtyping import Float, Int

from subterra_jax.b2 import constants as b2

Colour = tuple[float, float, float]

# Light covers tell the robot from ballast and sleepers, dark joints from its covers.
COVER, JOINT, RUBBER, GLASS, MARK = (
    (0.86, 0.87, 0.88), (0.13, 0.14, 0.16), (0.06, 0.06, 0.07), (0.05, 0.08, 0.13), (0.95, 0.45, 0.08),
)  # fmt: skip
_AROUND = 32  # points of a cross-section
_ROUNDING = 5  # sections of a rounded end


@dataclasses.dataclass(frozen=True)
class ShapePart:
    """A closed surface in the frame of its body."""

    vertices: Float[np.ndarray, "v 3"]  # vertices, m, `(v, 3)`
    faces: Int[np.ndarray, "f 3"]  # rows of three vertices, counter-clockwise from outside, `(f, 3)`
    colour: Colour  # Red, green, blue, 0 to 1


Section = tuple[float, float, float, float, float]


def loft(
    sections: Sequence[Section], colour: Colour, axis: str = "x", square: float = 2.0, rounding: float = 0.0
) -> ShapePart:
    """Return a body through cross-sections along an axis, closed at both ends.

    Args:
        sections: Place along the axis, middle across (two) and half sizes across (two), m, in order of the place. The
            two directions across are y, z for `x`; z, x for `y`; and x, y for `z`.
        colour: Red, green, blue, 0 to 1.
        axis: `x`, `y` or `z`.
        square: Exponent of the superellipse: 2 is an ellipse, larger is nearer to a rectangle.
        rounding: Length of the rounded ends, m, within the given places.
    """
    rows = _round_ends(np.array(sections, float), rounding)
    angle = np.arange(_AROUND) * (2.0 * np.pi / _AROUND)
    unit = np.stack([np.sign(part) * np.abs(part) ** (2.0 / square) for part in (np.cos(angle), np.sin(angle))], -1)
    rings = rows[:, None, 1:3] + rows[:, None, 3:5] * unit
    along = np.broadcast_to(rows[:, :1, None], (*rings.shape[:2], 1))
    points = np.concatenate([along, rings], axis=-1).reshape(-1, 3)
    caps = np.column_stack([rows[[0, -1], 0], rows[[0, -1], 1:3]])
    first = np.arange(len(rows) - 1)[:, None] * _AROUND + np.arange(_AROUND)
    after = first - np.arange(_AROUND) + (np.arange(_AROUND) + 1) % _AROUND
    quads = [
        np.stack([first, after, first + _AROUND], -1).reshape(-1, 3),
        np.stack([after, after + _AROUND, first + _AROUND], -1).reshape(-1, 3),
    ]
    ring, n = np.arange(_AROUND), len(points)
    ends = [
        np.stack([np.full(_AROUND, n), (ring + 1) % _AROUND, ring], -1),
        np.stack([np.full(_AROUND, n + 1), n - _AROUND + ring, n - _AROUND + (ring + 1) % _AROUND], -1),
    ]
    order = {"x": (0, 1, 2), "y": (2, 0, 1), "z": (1, 2, 0)}[axis]
    return ShapePart(np.concatenate([points, caps])[:, order], np.concatenate([*quads, *ends]), colour)


def _round_ends(rows: Float[np.ndarray, "n 5"], rounding: float) -> Float[np.ndarray, "m 5"]:
    """Return sections whose ends are drawn in along a quarter of an ellipse."""
    if rounding <= 0.0:
        return rows
    low, high = rows[0, 0], rows[-1, 0]
    turn = np.linspace(0.0, 0.5 * np.pi, _ROUNDING)
    inner = rows[(rows[:, 0] > low + rounding) & (rows[:, 0] < high - rounding), 0]
    places = np.concatenate(
        [low + rounding * (1.0 - np.cos(turn)), inner, high - rounding * (1.0 - np.cos(turn[::-1]))]
    )
    fraction = np.concatenate([np.sin(turn), np.ones(len(inner)), np.sin(turn[::-1])])
    apart = np.append(True, np.diff(places) > 1e-9)  # both ends of a ball meet in its middle
    places, fraction = places[apart], fraction[apart]
    made = np.column_stack([places, *(np.interp(places, rows[:, 0], column) for column in rows.T[1:])])
    made[:, 3:] *= np.maximum(fraction, 0.05)[:, None]
    return made


def _disc(x: float, z: float, low: float, high: float, radius: float, colour: Colour, rounding: float) -> ShapePart:
    """Return a wheel-like housing with its axis to the left, between two places along y, m."""
    low, high = min(low, high), max(low, high)
    return loft([(low, z, x, radius, radius), (high, z, x, radius, radius)], colour, "y", rounding=rounding)


def _trunk() -> list[ShapePart]:
    """Return hull, deck, head, tail, shoulders and LiDAR; half sizes of the hull are those of the collision box."""
    hull = [
        (-0.37, 0.0, 0.005, 0.105, 0.055), (-0.25, 0.0, 0.0, 0.14, 0.075), (0.0, 0.0, 0.002, 0.14, 0.077),
        (0.25, 0.0, 0.0, 0.14, 0.075), (0.37, 0.0, 0.005, 0.105, 0.055),
    ]  # fmt: skip
    lidar = b2.LIDAR[0], b2.LIDAR[2] - 0.02  # the frame lies 2 cm above the middle of the housing
    foot, top = lidar[1] - 0.08, lidar[1] + 0.08
    parts = [
        loft(hull, COVER, square=4.5, rounding=0.045),
        loft([(-0.24, 0.0, 0.072, 0.095, 0.018), (0.22, 0.0, 0.072, 0.095, 0.018)], JOINT, square=5.0, rounding=0.02),
        loft([(-0.30, 0.0, -0.066, 0.10, 0.022), (0.30, 0.0, -0.066, 0.10, 0.022)], JOINT, square=4.0, rounding=0.03),
        loft([(0.33, 0.0, 0.005, 0.072, 0.062), (0.43, 0.0, 0.005, 0.06, 0.07)], JOINT, square=4.0, rounding=0.025),
        loft([(0.41, 0.0, 0.02, 0.045, 0.022), (0.438, 0.0, 0.02, 0.04, 0.018)], GLASS, square=3.0, rounding=0.01),
        loft([(-0.4175, 0.0, 0.005, 0.06, 0.07), (-0.33, 0.0, 0.005, 0.072, 0.06)], JOINT, square=4.0, rounding=0.02),
        loft([(foot, lidar[0], 0.0, 0.07, 0.07), (foot + 0.07, lidar[0], 0.0, 0.05, 0.05)], JOINT, "z", rounding=0.01),
        loft([(foot + 0.065, lidar[0], 0.0, 0.048, 0.048), (top - 0.03, lidar[0], 0.0, 0.048, 0.048)], GLASS, "z"),
        loft([(top - 0.03, lidar[0], 0.0, 0.052, 0.052), (top, lidar[0], 0.0, 0.05, 0.05)], COVER, "z", rounding=0.012),
    ]
    for side in (1.0, -1.0):
        stripe = [(-0.2, side * 0.137, 0.028, 0.006, 0.009), (0.2, side * 0.137, 0.028, 0.006, 0.009)]
        parts.append(loft(stripe, MARK, rounding=0.01))
        lamp = [(0.41, side * 0.042, 0.045, 0.008, 0.008), (0.430, side * 0.042, 0.045, 0.008, 0.008)]
        parts.append(loft(lamp, MARK, rounding=0.004))
        for end in (1.0, -1.0):  # the motor that turns the leg sideways
            ends = sorted((end * (b2.HIP_X - 0.115), end * (b2.HIP_X - 0.05)))
            motor = [(x, side * b2.HIP_Y, 0.0, 0.058, 0.058) for x in ends]
            parts.append(loft(motor, JOINT, rounding=0.012))
    return parts


def _hip(side: float) -> list[ShapePart]:
    """Return the bracket and the housing of the thigh's motor, of the collision cylinder's radius."""
    bracket = sorted((side * -0.02, side * 0.075))
    return [
        loft([(-0.055, 0.0, 0.0, 0.055, 0.055), (0.055, 0.0, 0.0, 0.055, 0.055)], JOINT, rounding=0.015),
        loft([(y, 0.0, 0.0, 0.05, 0.055) for y in bracket], JOINT, "y", square=3.0, rounding=0.01),
        _disc(0.0, 0.0, side * 0.045, side * 0.094, 0.07, JOINT, 0.012),
    ]


def _thigh(side: float) -> list[ShapePart]:
    """Return the cover that narrows towards the knee, the knee's motor at its top and the knee."""
    cover = [
        (-b2.LINK - 0.03, 0.0, 0.0, 0.030, 0.020), (-b2.LINK, 0.0, 0.0, 0.036, 0.024),
        (-0.27, -0.012, 0.0, 0.036, 0.026), (-0.16, -0.026, 0.0, 0.046, 0.030), (-0.07, -0.014, 0.0, 0.064, 0.034),
        (0.0, 0.0, 0.0, 0.074, 0.036), (0.075, 0.0, 0.0, 0.06, 0.034),
    ]  # fmt: skip
    return [
        loft(cover, COVER, "z", square=2.6, rounding=0.035),
        _disc(0.0, 0.0, side * 0.026, side * 0.055, 0.062, JOINT, 0.012),
        _disc(0.0, 0.0, side * 0.052, side * 0.059, 0.03, MARK, 0.003),
        _disc(0.0, -b2.LINK, -0.032, 0.032, 0.034, JOINT, 0.008),
    ]


def _calf() -> list[ShapePart]:
    """Return the shank, bowed forward as the collision boxes are, and the rubber above the foot."""
    shank = [
        (-b2.LINK + 0.015, 0.006, 0.0, 0.014, 0.014), (-0.30, 0.017, 0.0, 0.013, 0.013),
        (-0.20, 0.034, 0.0, 0.016, 0.014), (-0.10, 0.022, 0.0, 0.022, 0.016), (0.0, 0.0, 0.0, 0.028, 0.020),
        (0.028, -0.004, 0.0, 0.022, 0.018),
    ]  # fmt: skip
    rubber = [(-b2.LINK - 0.005, 0.0, 0.0, 0.028, 0.028), (-b2.LINK + 0.05, 0.008, 0.0, 0.017, 0.017)]
    radius = b2.FOOT_RADIUS
    foot = [(-b2.LINK - radius, 0.0, 0.0, radius, radius), (-b2.LINK + radius, 0.0, 0.0, radius, radius)]
    return [
        loft(shank, JOINT, "z", square=2.4, rounding=0.015),
        loft(rubber, RUBBER, "z", rounding=0.01),
        loft(foot, RUBBER, "z", rounding=radius),
    ]


@cache
def shape_of(body: str) -> tuple[ShapePart, ...]:
    """Return the looks of a body by its name in the model, as `base_link` or `FL_thigh`.

    Raises:
        KeyError: The robot has no such body.
    """
    if body == "base_link":
        return tuple(_trunk())
    leg, part = body.split("_", 1)
    if leg not in b2.LEGS or part not in b2.PARTS:
        raise KeyError(body)
    side = 1.0 if leg[1] == "L" else -1.0
    return tuple({"hip": lambda: _hip(side), "thigh": lambda: _thigh(side), "calf": _calf}[part]())
