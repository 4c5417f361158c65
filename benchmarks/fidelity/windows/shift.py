"""Shift along the tunnel by window, and which side is left, from the relief of the walls."""

import numpy as np
from jaxtyping import Float, Int

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.curve import nanmedian, section_angles
from benchmarks.fidelity.windows import deviation

REACH = 0.40  # m; largest shift that is looked for: a quarter of a ring, so that the next one is not taken for it
_STEPS = round(REACH / deviation.FINE)  # shifts that are tried to either side, `FINE` apart
_DEEPEST = 0.10  # m; larger differences count as this
_LEAST_CONTRAST = 0.0008  # m that the best shift must fit better than a wrong one
_POINTS = 20_000
_FEWEST_CELLS = 50
_NUDGE = 0.01  # m


def shift_by_window(
    station: Float[np.ndarray, " n"],
    angle: Float[np.ndarray, " n"],
    radius: Float[np.ndarray, " n"],
    judged: deviation.Relief,
    starts: Float[np.ndarray, " k"],
    window: float,
) -> Float[np.ndarray, " k"]:
    """Return how far the relief of the candidate lies along the tunnel from that of points, by window, m.

    A wall that is out as a whole does not matter. NaN where the walls are too even to tell, or where no shift within
    `REACH` fits best.

    Args:
        station: Station of the points, m.
        angle: Angle of the points, rad.
        radius: Distance of the points from the middle, m.
        judged: Relief of the candidate about the same middle.
        starts: Starts of the windows, m.
        window: Their length, m.
    """
    order = np.argsort(station, kind="stable")
    station, radius = station[order], radius[order]
    turn = (angle[order] + np.pi) / (2.0 * np.pi)
    sector = (turn * deviation.SECTORS).astype(int) % deviation.SECTORS
    padded, cell = _cells_of(station, (turn * deviation.COLUMNS).astype(int) % deviation.COLUMNS, judged)
    steps = np.arange(-_STEPS, _STEPS + 1)
    result = np.full(len(starts), np.nan)
    for k, (first, last) in enumerate(np.searchsorted(station, [starts, starts + window]).T):
        rows = slice(first, last, max((last - first) // _POINTS, 1))
        if len(station[rows]) < 500:
            continue
        errors = _misfits(station[rows], sector[rows], radius[rows], cell[rows], padded, steps)
        best = int(np.argmin(errors))
        if not 0 < best < len(steps) - 1 or np.median(errors) - errors[best] < _LEAST_CONTRAST:
            continue
        result[k] = steps[best] * deviation.FINE + _vertex(errors, best)
    return result


def _cells_of(
    station: Float[np.ndarray, " n"], column: Int[np.ndarray, " n"], judged: deviation.Relief
) -> tuple[Float[np.ndarray, " c"], Int[np.ndarray, " n"]]:
    """Return the radii of a relief in one row, NaN before and behind it, and the place of each point in them.

    A point that moves by one step lies `COLUMNS` places on: all shifts of a window read the same places.
    """
    beyond = np.full((2 * _STEPS + 1, deviation.COLUMNS), np.nan)
    padded = np.concatenate([beyond, judged.radius, beyond])
    row = np.round((station - judged.station[0]) / deviation.FINE).astype(int)
    row = np.clip(row, -_STEPS - 1, len(judged.station) + _STEPS) + len(beyond)
    return padded.ravel(), row * deviation.COLUMNS + column


def _misfits(
    station: np.ndarray, sector: np.ndarray, radius: np.ndarray, cell: np.ndarray, judged: np.ndarray, steps: np.ndarray
) -> Float[np.ndarray, " s"]:
    """Return the mean difference of both reliefs for each shift of the points, m; NaN where none is known.

    Each is taken about its own straight line in each direction, at the same points: a wall that runs askew to the
    curve, or points that crowd at one end of the window, move nothing.
    """
    here = judged[cell]
    known = np.isfinite(here)
    lines = [_line_by_sector(station[known], values[known], sector[known]) for values in (radius, here)]
    apart = radius - _on_line(lines[0], station, sector) + _on_line(lines[1], station, sector)
    slope = lines[1][2][sector]
    errors = np.full(len(steps), np.nan)
    for k, step in enumerate(steps):
        gap = judged[cell + step * deviation.COLUMNS]
        np.subtract(apart + slope * (step * deviation.FINE), gap, out=gap)
        unknown = int(np.count_nonzero(np.isnan(gap)))
        if unknown < len(gap):
            total = np.fmin(np.abs(gap, out=gap), _DEEPEST, out=gap).sum()  # what is unknown counts as `_DEEPEST` here
            errors[k] = (total - unknown * _DEEPEST) / (len(gap) - unknown)
    return errors


def _line_by_sector(
    station: np.ndarray, values: np.ndarray, sector: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fits a straight line along the tunnel in each direction: mean station, mean value and slope."""
    count = np.maximum(np.bincount(sector, minlength=deviation.SECTORS), 1)
    middle = np.bincount(sector, station, deviation.SECTORS) / count
    level = np.bincount(sector, values, deviation.SECTORS) / count
    off = station - middle[sector]
    spread = np.bincount(sector, off**2, deviation.SECTORS)
    slope = np.bincount(sector, off * (values - level[sector]), deviation.SECTORS) / np.maximum(spread, 1e-9)
    return middle, level, slope


def _on_line(
    line: tuple[np.ndarray, np.ndarray, np.ndarray], station: np.ndarray, sector: np.ndarray
) -> Float[np.ndarray, " n"]:
    middle, level, slope = line
    return level[sector] + slope[sector] * (station - middle[sector])


def _vertex(errors: np.ndarray, best: int) -> float:
    """Return the place of the least error beside the best shift, m, by a parabola."""
    before, here, after = errors[best - 1 : best + 2]
    bend = before - 2.0 * here + after
    return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5) * deviation.FINE) if bend > 0.0 else 0.0


def hold_shift(case: Case, starts: Float[np.ndarray, " k"], window: float) -> Float[np.ndarray, " k"]:
    """Return the shift of the candidate against the held-out returns on its walls, m; ahead positive."""
    frame = deviation.hold_frame(case)
    wall = (frame.cell >= 0) & ~deviation.is_floor(frame.angle) & np.isin(deviation.parts_hit(case), ("lining", "nail"))
    local = frame.local[wall]
    radius = np.hypot(local[:, 1], local[:, 2])
    return shift_by_window(local[:, 0], frame.angle[wall], radius, deviation.relief_on_path(case), starts, window)


def truth_shift(case: Case, starts: Float[np.ndarray, " k"], window: float) -> Float[np.ndarray, " k"]:
    """Return the shift of the candidate against the truth, m; ahead positive."""
    real = deviation.truth_relief(case)
    angle = section_angles(deviation.COLUMNS)
    wall = ~deviation.is_floor(angle)
    station, around = np.meshgrid(real.station, angle[wall], indexing="ij")
    radius = real.radius[:, wall]
    known = np.isfinite(radius)
    return shift_by_window(
        station[known], around[known], radius[known], deviation.relief_on_truth(case), starts, window
    )


def handedness(reference: Float[np.ndarray, "n m"], judged: Float[np.ndarray, "n m"]) -> tuple[float, float]:
    """Return the correlation of what differs left from right in two maps of radii, and its size in the second, m.

    1 where each side is where it belongs, -1 in a mirror. What a sideways shift of the middle does to both is taken
    out first. NaN where fewer than 50 cells are known on both sides.
    """
    real, mine = _one_sided(reference), _one_sided(judged)
    known = np.isfinite(real) & np.isfinite(mine)
    if known.sum() < _FEWEST_CELLS or min(np.std(real[known]), np.std(mine[known])) <= 0.0:
        return float("nan"), 0.0
    return float(np.corrcoef(real[known], mine[known])[0, 1]), float(np.std(mine[known]))


def _one_sided(radius: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n h"]:
    """Return half the difference of left and right by cell, without each row's shift and each direction's median."""
    angle = section_angles(deviation.SECTORS)
    left = np.flatnonzero((np.abs(angle) < np.pi / 2) & ~deviation.is_floor(angle))
    mirror = np.argmin(np.abs(np.angle(np.exp(1j * (angle[None] - (np.pi - angle[left])[:, None])))), axis=1)
    half = (radius[:, left] - radius[:, mirror]) / 2.0
    template = _shift_template(nanmedian(radius.T), angle)[left]
    known = np.isfinite(half) & np.isfinite(template)
    weight = np.where(known, template**2, 0.0).sum(axis=1)
    aside = np.where(known, half * template, 0.0).sum(axis=1) / np.maximum(weight, 1e-9)
    half = np.clip(half - aside[:, None] * template, -_DEEPEST, _DEEPEST)
    return half - nanmedian(half.T)[None]


def _shift_template(radius: Float[np.ndarray, " m"], angle: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Return by how much each radius of a section grows if the section moves to the left, m/m."""
    known = np.isfinite(radius)
    x, y = radius[known] * np.cos(angle[known]) + _NUDGE, radius[known] * np.sin(angle[known])
    turned, grown = np.arctan2(y, x), np.hypot(x, y)
    order = np.argsort(turned)
    moved = np.interp(angle, turned[order], grown[order], period=2.0 * np.pi)
    return np.where(known, (moved - radius) / _NUDGE, np.nan)
