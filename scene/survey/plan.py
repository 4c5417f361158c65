"""What the centrelines are made of: straights, clothoids and arcs in plan, grades with vertical curves in profile."""

import numpy as np

from scene.survey.alignment import MARGIN, Elements

_GRADE_STEP = 25.0  # m between the knots of the grade


def draw_railway(rng: np.random.Generator, length: float) -> Elements:
    """Bends of 150 to 400 m radius, each the other way than the last, and grades within ±1 %.

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
    profile = np.arange(-MARGIN, length + MARGIN + 2 * _GRADE_STEP, _GRADE_STEP)
    grade = np.repeat(rng.uniform(-0.01, 0.01, (len(profile) + 1) // 2), 2)[: len(profile)]
    return Elements(np.array(knots), np.array(curvature), profile, grade)


def draw_s_bend(rng: np.random.Generator, length: float) -> Elements:
    """Arcs of 60 m radius by turns to either side, with clothoids between, and grades within ±1 %.

    The arcs take a fifth of the length each, but no more than 40 m, which turns by 38°.
    """
    run = float(np.clip(0.2 * length, 2.0, 40.0))
    clothoid = 0.5 * run
    knots, curvature = [-MARGIN, 0.25 * clothoid], [0.0, 0.0]
    bend = rng.choice([-1.0, 1.0]) / 60.0
    while knots[-1] < length + MARGIN:
        for step, value in ((clothoid, bend), (run, bend), (clothoid, 0.0)):
            knots.append(knots[-1] + step)
            curvature.append(value)
        bend = -bend
    railway = draw_railway(rng, length)
    return Elements(np.array(knots), np.array(curvature), railway.profile, railway.grade)


def draw_grade(rng: np.random.Generator, length: float) -> Elements:
    """A railway in plan that climbs at 3 % throughout."""
    railway = draw_railway(rng, length)
    return Elements(railway.plan, railway.curvature, railway.profile, np.full_like(railway.grade, 0.03))


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


def metro(rng: np.random.Generator, length: float) -> Elements:
    """The first `length` m of a 351 m window of a real metro, as built. Nothing is drawn."""
    return Elements(_METRO_KNOTS, _METRO_CURVATURE, _METRO_KNOTS, _METRO_GRADE)
