"""The true centreline by arc length: straights, clothoids and arcs in plan, grades with vertical curves in profile."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline

TABLE_STEP = 0.05  # m, spacing of the integration table
MARGIN = 30.0  # m of alignment beyond either mouth, where the carrier starts


@dataclass(frozen=True)
class Frames:
    """Right-handed frames on the centreline."""

    position: Float[np.ndarray, "n 3"]  # Points of the centreline in the survey frame, m
    tangent: Float[np.ndarray, "n 3"]  # Unit vectors of growing station
    lateral: Float[np.ndarray, "n 3"]  # Unit vectors to the left, horizontal
    up: Float[np.ndarray, "n 3"]  # Unit vectors; sections lie in the plane of `lateral` and `up`

    def point(self, y: Float[np.ndarray, "n *m"], z: Float[np.ndarray, "n *m"]) -> Float[np.ndarray, "n *m 3"]:
        """Return points at `y` along `lateral` and `z` along `up` of each frame, m."""
        extra = (slice(None),) + (None,) * (np.ndim(y) - 1)
        return self.position[extra] + y[..., None] * self.lateral[extra] + z[..., None] * self.up[extra]

    @property
    def matrix(self) -> Float[np.ndarray, "n 3 3"]:
        """Columns `tangent`, `lateral`, `up`: takes section coordinates to the survey frame."""
        return np.stack([self.tangent, self.lateral, self.up], axis=-1)


@dataclass(frozen=True)
class Alignment:
    """A centreline by arc length."""

    length: float  # Length between the mouths, m. Stations from `-MARGIN` to `length + MARGIN` are defined
    curve: CubicHermiteSpline  # Station to position, m
    heading: CubicHermiteSpline  # Station to heading from the survey x axis, rad
    slope: CubicHermiteSpline  # Station to angle above the horizontal, rad

    def frames(self, station: Float[np.ndarray, "n"]) -> Frames:
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
    """Piecewise linear curvature in plan and grade in profile, constant beyond the ends."""

    plan: Float[np.ndarray, "p"]  # Stations of the knots of the curvature, m
    curvature: Float[np.ndarray, "p"]  # Curvature at these knots, 1/m; positive turns left
    profile: Float[np.ndarray, "q"]  # Stations of the knots of the grade, m
    grade: Float[np.ndarray, "q"]  # Grade at these knots, rise over run


def lay_out(rng: np.random.Generator, length: float, elements: Elements) -> Alignment:
    """Return the centreline of `elements`, of a length between the mouths, m.

    The survey frame has z up; heading and origin in it are drawn, so that no axis of the frame follows the bore.
    """
    heading = rng.uniform(-np.pi, np.pi)
    origin = np.concatenate([rng.uniform(-2000.0, 2000.0, 2), rng.uniform(-40.0, 40.0, 1)])
    n = round((length + 2 * MARGIN) / TABLE_STEP) + 1
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


_GRADE_STEP = 25.0  # m between the knots of the grade


def draw_railway(rng: np.random.Generator, length: float) -> Elements:
    """Draws bends of 150 to 400 m radius, to either side in turn, and grades within ±1 %."""
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
    profile = np.arange(-MARGIN, length + MARGIN + 2 * _GRADE_STEP, _GRADE_STEP)
    grade = np.repeat(rng.uniform(-0.01, 0.01, (len(profile) + 1) // 2), 2)[: len(profile)]
    return Elements(np.array(knots), np.array(curvature), profile, grade)


# Source: the ring centres of a real metro shield tunnel, `export_best_fit_result.csv` of
# github.com/suben-mk/As-built-Tunnel-Segment-Center-Rev.05 (© 2021 Suben Mukem, MIT), 65 rings on 448 m. Derived by
# least squares: curvature and grade, linear between knots 30 m apart, integrated to plan positions and heights, fitted
# to the centres; they are met within 9.7 mm RMS in plan and 6.0 mm in height. Station 0 is 820 m from the centre of
# the ring of highest number, against the file's chainage. To station 351 it turns 9° left, then 43° right: radii of
# 400 and of 220 to 240 m.
_METRO_KNOTS = np.arange(-60.0, 421.0, 30.0)
_METRO_CURVATURE = 1e-3 * np.array(
    [-0.30, 0.96, 2.26, 2.48, 1.67, 0.14, 0.00, -0.08, -2.04, -4.58, -4.17, -4.47, -4.26, -4.42, -4.36, -4.10, -4.10]
)
_METRO_GRADE = 1e-3 * np.array(
    [5.20, 4.62, 5.12, 3.41, 2.47, 4.19, 3.46, 4.37, 5.27, 3.99, 3.48, 3.94, 3.67, 3.21, 4.26, 4.37, 4.37]
)


def metro_elements(rng: np.random.Generator, length: float) -> Elements:
    """Return the first `length` m of a 351 m window of a real metro, as built. Nothing is drawn."""
    return Elements(_METRO_KNOTS, _METRO_CURVATURE, _METRO_KNOTS, _METRO_GRADE)
