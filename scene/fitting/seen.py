"""How much of the bore a survey shows: its ends, and how far apart its profiles stand."""

import numpy as np
from scipy.ndimage import uniform_filter1d

from scene.axis import Axis
from scene.errors import FitError
from scene.fitting.unroll import Grid

DENSE_STEP = 0.25  # m; where nearly every row of this length was seen, the survey is no row of profiles
OVERRUN = 3.0  # m beyond the axis that are looked at
_STEPS = (DENSE_STEP, 0.5, 1.0, 1.5, 2.0)  # m
_MIN_ROWS_SEEN = 0.9
_MOST_GAPS = 0.4  # of the rows: with more unseen the survey is profiles too far apart
_END_COVERAGE = 0.4
_DENSE = 0.7
_TRIM_STEP = 0.05


def seen_span(station: np.ndarray, angle: np.ndarray, axis: Axis) -> tuple[float, float]:
    """First and last station where a fair share of the circumference was seen, m.

    Raises:
        FitError: No station shows that much.
    """
    grid = Grid.over(-OVERRUN, axis.length + OVERRUN, DENSE_STEP, 24)
    cell = grid.cell(station, angle)
    count = np.bincount(cell[cell >= 0], minlength=grid.rows * grid.columns).reshape(grid.rows, grid.columns)
    rows = np.flatnonzero((count > 0).mean(axis=1) > _END_COVERAGE)
    if len(rows) and len(rows) >= _DENSE * (rows[-1] - rows[0] + 1):
        first, last = grid.start + rows[0] * grid.step, grid.start + (rows[-1] + 1) * grid.step
        inside = station[(station >= first) & (station <= last)]
        return _trimmed(inside, first, 1), -_trimmed(-inside, -last, 1)
    # Profiles apart, and aslant to the axis where the bore flares: the first and the last one are the ends.
    rows = np.flatnonzero((uniform_filter1d((count > 0).astype(float), 3, axis=0) > 0).mean(axis=1) > _END_COVERAGE)
    if not len(rows):
        raise FitError("no tunnel in the cloud: hardly a section shows most of its circumference")
    first, last = (grid.start + (row + 0.5) * grid.step for row in (rows[0], rows[-1]))
    return _middle(station, first, 1), _middle(station, last, -1)


def _middle(station: np.ndarray, outermost: float, inwards: int) -> float:
    """Station of the profile whose outermost points lie near a station, m."""
    ahead = inwards * (station - outermost)
    return float(np.median(station[(ahead > -2 * DENSE_STEP) & (ahead < 3 * DENSE_STEP)]))


def _trimmed(station: np.ndarray, end: float, behind: float) -> float:
    """Where the returns become as many as further inside: noise spills a few of them over a mouth.

    Args:
        station: Growing inwards, m.
        end: Where the first returns are, m.
        behind: How far inside to look, m.
    """
    step = _TRIM_STEP
    total = np.histogram(station, np.arange(end - 0.5, end + 2 * behind, step))[0]
    reach = round(behind / step)
    full = [k for k in range(len(total) - reach) if 2 * total[k] > np.median(total[k + 1 : k + 1 + reach]) > 0]
    return end - 0.5 + (full[0] if full else 0) * step


def profile_spacing(station: np.ndarray, start: float, end: float) -> float:
    """The shortest row of which nearly all were seen, m: `DENSE_STEP` unless the survey is profiles some way apart.

    Raises:
        FitError: Profiles further apart than 2 m.
    """
    inside = station[(station >= start) & (station <= end)]
    for step in _STEPS:
        edges = np.arange(start, end, step)
        if _share_seen(np.histogram(inside, np.append(edges, end))[0] > 0, step) >= _MIN_ROWS_SEEN:
            return step
    raise FitError(f"profiles more than {_STEPS[-1]:g} m apart leave the wall between them unknown")


def _share_seen(seen: np.ndarray, step: float) -> float:
    """Share of rows seen, without the gaps of a survey: a few long runs of rows unseen."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (~seen).astype(int), [0]])))
    runs = (edges[1::2] - edges[::2]) * step
    gaps = float(runs[runs > _STEPS[-1]].sum()) / step
    return float(seen.sum() / (len(seen) - (gaps if gaps < _MOST_GAPS * len(seen) else 0.0)))
