"""The true centreline by arc length, and the frames on it."""

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


@dataclass(frozen=True)
class Elements:
    """What a centreline is made of: piecewise linear curvature in plan and grade in profile, constant beyond the ends.

    Attributes:
        plan: Stations of the knots of the curvature, m.
        curvature: There, 1/m; positive turns left.
        profile: Stations of the knots of the grade, m.
        grade: There, rise over run.
    """

    plan: Float[np.ndarray, "p"]
    curvature: Float[np.ndarray, "p"]
    profile: Float[np.ndarray, "q"]
    grade: Float[np.ndarray, "q"]


def lay_out(rng: np.random.Generator, length: float, elements: Elements) -> Alignment:
    """The centreline of `elements`.

    The survey frame has z up; heading and origin in it are drawn, so that no axis of the frame follows the bore.

    Args:
        rng: Source of randomness.
        length: Length between the mouths, m.
        elements: Curvature and grade by station.
    """
    heading = rng.uniform(-np.pi, np.pi)
    origin = np.concatenate([rng.uniform(-2000.0, 2000.0, 2), rng.uniform(-40.0, 40.0, 1)])
    n = round((length + 2 * MARGIN) / STEP) + 1
    s = np.linspace(-MARGIN, length + MARGIN, n)
    kappa = np.interp(s, elements.plan, elements.curvature)
    slope = np.arctan(np.interp(s, elements.profile, elements.grade))
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
