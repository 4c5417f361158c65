"""The true centreline: straights, clothoids and arcs in plan, grades with vertical curves in profile."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline

STEP = 0.05  # m, spacing of the integration table
MARGIN = 30.0  # m of alignment beyond either mouth, where the carrier starts


@dataclass(frozen=True)
class Frames:
    """Right-handed frames on the centreline.

    Attributes:
        position: Points of the centreline in the survey frame, m.
        tangent: Unit vectors of growing station.
        lateral: Unit vectors to the left, horizontal.
        up: Unit vectors; sections lie in the plane of `lateral` and `up`.
    """

    position: Float[np.ndarray, "n 3"]
    tangent: Float[np.ndarray, "n 3"]
    lateral: Float[np.ndarray, "n 3"]
    up: Float[np.ndarray, "n 3"]

    def point(self, y: Float[np.ndarray, "n *m"], z: Float[np.ndarray, "n *m"]) -> Float[np.ndarray, "n *m 3"]:
        """Points at `y` along `lateral` and `z` along `up` of each frame, m."""
        extra = (slice(None),) + (None,) * (np.ndim(y) - 1)
        return self.position[extra] + y[..., None] * self.lateral[extra] + z[..., None] * self.up[extra]

    @property
    def matrix(self) -> Float[np.ndarray, "n 3 3"]:
        """Columns `tangent`, `lateral`, `up`: takes section coordinates to the survey frame."""
        return np.stack([self.tangent, self.lateral, self.up], axis=-1)


@dataclass(frozen=True)
class Alignment:
    """A centreline by arc length.

    Attributes:
        length: Length between the mouths, m. Stations from `-MARGIN` to `length + MARGIN` are defined.
        curve: Station to position, m.
        heading: Station to heading from the survey x axis, rad.
        slope: Station to angle above the horizontal, rad.
    """

    length: float
    curve: CubicHermiteSpline
    heading: CubicHermiteSpline
    slope: CubicHermiteSpline

    def frames(self, station: Float[np.ndarray, "n"]) -> Frames:
        """Frames at `station`, m."""
        heading, slope = self.heading(station), self.slope(station)
        ch, sh, cs, ss = np.cos(heading), np.sin(heading), np.cos(slope), np.sin(slope)
        return Frames(
            position=self.curve(station),
            tangent=np.stack([cs * ch, cs * sh, ss], axis=-1),
            lateral=np.stack([-sh, ch, np.zeros_like(sh)], axis=-1),
            up=np.stack([-ss * ch, -ss * sh, cs], axis=-1),
        )


def draw_alignment(rng: np.random.Generator, length: float) -> Alignment:
    """Draw a centreline.

    Curvature in plan is continuous and piecewise linear: straight, clothoid, arc of 150 to 400 m radius, clothoid, and
    so on, each bend the other way. The grade stays within ±1 % and changes linearly with station (vertical curves).
    The survey frame has z up; heading and origin in it are drawn, so that no axis of the frame follows the bore.

    Args:
        rng: Source of randomness.
        length: Length between the mouths, m.
    """
    # Short bores get short elements, so that 15 m bend too.
    scale = float(np.clip(length / 90.0, 0.2, 1.5))
    knots, curvature = [-MARGIN, rng.uniform(8.0, 16.0) * scale], [0.0, 0.0]
    side = rng.choice([-1.0, 1.0])
    while knots[-1] < length + MARGIN:
        bend = side / rng.uniform(150.0, 400.0)
        for run, value in (
            (rng.uniform(12.0, 25.0), bend),
            (rng.uniform(15.0, 45.0), bend),
            (rng.uniform(12.0, 25.0), 0.0),
            (rng.uniform(0.0, 20.0) + 1.0, 0.0),
        ):
            knots.append(knots[-1] + run * scale)
            curvature.append(value)
        side = -side

    grade_knots = np.arange(-MARGIN, length + MARGIN + 2 * 25.0, 25.0)
    grade = np.repeat(rng.uniform(-0.01, 0.01, (len(grade_knots) + 1) // 2), 2)[: len(grade_knots)]
    heading = rng.uniform(-np.pi, np.pi)
    origin = np.concatenate([rng.uniform(-2000.0, 2000.0, 2), rng.uniform(-40.0, 40.0, 1)])

    n = round((length + 2 * MARGIN) / STEP) + 1
    s = np.linspace(-MARGIN, length + MARGIN, n)
    kappa = np.interp(s, knots, curvature)
    slope = np.arctan(np.interp(s, grade_knots, grade))
    psi = np.concatenate([[0.0], np.cumsum(0.5 * (kappa[1:] + kappa[:-1]) * np.diff(s))])
    psi += heading - np.interp(0.0, s, psi)
    psi_of, slope_of = CubicHermiteSpline(s, psi, kappa), CubicHermiteSpline(s, slope, np.gradient(slope, s))

    def tangent(at: np.ndarray) -> np.ndarray:
        p, g = psi_of(at), slope_of(at)
        return np.stack([np.cos(g) * np.cos(p), np.cos(g) * np.sin(p), np.sin(g)], axis=-1)

    # Simpson's rule over each cell of the table.
    ends, h = tangent(s), np.diff(s)[:, None]
    steps = h / 6.0 * (ends[:-1] + 4.0 * tangent(0.5 * (s[1:] + s[:-1])) + ends[1:])
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    position += origin - CubicHermiteSpline(s, position, ends)(0.0)
    return Alignment(length, CubicHermiteSpline(s, position, ends), psi_of, slope_of)
