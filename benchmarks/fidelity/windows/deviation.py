"""Unrolled maps: how far the candidate lies from held-out points or truth, by place and along the tunnel."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from benchmarks.fidelity.case import Case, kept_until, per_case, per_hold, per_truth
from benchmarks.fidelity.derive import curve as curves
from benchmarks.fidelity.derive.beams import cast_beams, observed_extent, returns, sensor_path
from benchmarks.fidelity.derive.sections import truth_bore_caster
from benchmarks.fidelity.derive.surface import Caster, visible_parts
from benchmarks.fidelity.meshes import concatenate_meshes

CELL = 0.5  # m along the tunnel
SECTORS = 72  # cells around it, of 5 degrees
CAP = 0.5  # m; larger offsets count as this
LEAST = 4  # returns that make a cell known
FINE = 0.05  # m along the tunnel between rays of a relief
COLUMNS = 216  # rays of a relief around the tunnel
ANGLES = curves.section_angles(COLUMNS)
TRACK = ("sleeper", "rail", "fastening")  # parts of a candidate that are no bore
TRACK_SIDE = np.deg2rad(50.0)  # from straight down: what lies there may be track
_STEEPEST = np.cos(np.deg2rad(80.0))  # beams that graze more steeply say little about where a surface is
_BORE = 0.5  # fraction of a cell's returns off the candidate's track from which on it shows the bore
_MOUTH = 0.5  # m at the mouths that the truth's rays leave out


@dataclass(frozen=True)
class Unrolled:
    """Radius of the reference about the middle of its section, and what the candidate's surface lies beyond it."""

    curve: curves.Curve  # Curve that stations count along
    middle: tuple[float, float]  # Middle of the section to the left of and above the curve, m
    low: float  # Station where the first cells begin, m
    radius: Float[np.ndarray, "n m"]  # Median radius of the reference, m; NaN where it is not known
    offset: Float[np.ndarray, "n m"]  # Median offset of the candidate, m, outward positive; NaN where it is not known

    def place(self, station: float) -> Float[np.ndarray, "3"]:
        """Return the middle of the section at a station, tunnel frame, m."""
        return self.curve.point(np.array([[station, *self.middle]]))[0]


def is_floor(angle: Float[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """Return True for directions in which track may lie."""
    return np.cos(angle + np.pi / 2) > np.cos(TRACK_SIDE)


# By the held-out recording.


@dataclass(frozen=True)
class Frame:
    """Held-out returns about the middle of the section, along the sensor's path."""

    local: Float[np.ndarray, "n 3"]  # Station along the path, left and up of the section's middle, m
    angle: Float[np.ndarray, " n"]  # Angle about the middle from left towards up, rad
    middle: tuple[float, float]  # Middle of the section to the left of and above the path, m
    low: float  # low, high: Stations between which returns lie, m
    high: float
    cell: Int[np.ndarray, " n"]  # Number of the cell of each return; -1 outside these stations

    @property
    def rows(self) -> int:
        """Number of cells along the tunnel."""
        return max(int((self.high - self.low) / CELL), 1)


@per_hold
def hold_frame(case: Case) -> Frame:
    """Return the frame of the held-out returns; the middle lies half way between their extremes, strays left out."""
    low, high = observed_extent(case)
    local = returns(case).local.copy()
    inside = (local[:, 0] > low) & (local[:, 0] < high)
    middle = np.percentile(local[inside, 1:], [0.5, 99.5], axis=0).mean(axis=0)
    local[:, 1:] -= middle
    angle = np.arctan2(local[:, 2], local[:, 1])
    row = np.floor((local[:, 0] - low) / CELL).astype(int)
    column = ((angle + np.pi) / (2.0 * np.pi) * SECTORS).astype(int) % SECTORS
    cell = np.where((row >= 0) & (row < max(int((high - low) / CELL), 1)), row * SECTORS + column, -1)
    return Frame(local, angle, (float(middle[0]), float(middle[1])), low, high, cell)


@kept_until("LIN", per_case)
def beam_offsets(case: Case) -> Float[np.ndarray, " n"]:
    """Return the offset of the candidate's surface along its normal at each return, m; NaN where a beam only grazes it.

    Positive where the candidate lies beyond the return. A beam that leaves the candidate counts as `CAP`.
    """
    cast = cast_beams(case)
    offset = np.where(cast.hit, np.where(cast.hit, cast.difference, 0.0) * cast.cosine, CAP)
    return np.where(~cast.hit | (cast.cosine > _STEEPEST), np.clip(offset, -CAP, CAP), np.nan)


@kept_until("LIN", per_case)
def parts_hit(case: Case) -> np.ndarray:
    """Return the name of the candidate's part that each beam meets; empty where it meets nothing, `(n,)`."""
    face = cast_beams(case).face
    return np.where(face >= 0, visible_parts(case.candidate)[face], "")


@per_case
def hold_map(case: Case) -> Unrolled:
    """Return the map against the held-out returns; those on the candidate's track are left out.

    A cell that shows mostly track is not known: its other returns are those that miss an edge of the track by a hair,
    and met far behind it.
    """
    frame, offset = hold_frame(case), beam_offsets(case)
    shape = (frame.rows, SECTORS)
    off_track = ~np.isin(parts_hit(case), TRACK)
    inside = frame.cell >= 0
    count = np.bincount(frame.cell[inside], minlength=shape[0] * shape[1])
    free = np.bincount(frame.cell[inside & off_track], minlength=shape[0] * shape[1])
    off_track &= (free >= _BORE * count)[frame.cell]

    def medians(rows: np.ndarray, values: np.ndarray) -> np.ndarray:
        return curves.grouped_median(frame.cell[rows], values[rows], shape[0] * shape[1], LEAST).reshape(shape)

    known = inside & off_track
    radius = medians(known, np.hypot(frame.local[:, 1], frame.local[:, 2]))
    return Unrolled(sensor_path(case), frame.middle, frame.low, radius, medians(known & np.isfinite(offset), offset))


# By the truth.


@dataclass(frozen=True)
class Relief:
    """Radii of one surface about a curve: rows every `FINE` metres, columns every `COLUMNS`-th of a turn."""

    station: Float[np.ndarray, " n"]  # m
    radius: Float[np.ndarray, "n m"]  # m; NaN where a ray meets nothing


@kept_until("LIN", per_case)
def bore_caster(case: Case) -> Caster:
    """Return the caster of rays into lining, bed and further bodies of the candidate, without its track."""
    one = case.candidate
    return Caster(concatenate_meshes([part for part in (one.lining, one.bed, one.extra) if len(part.faces)]))


@per_truth
def truth_relief(case: Case) -> Relief:
    curve = curves.truth_curve(case)
    stations = np.arange(_MOUTH + FINE / 2, curve.length - _MOUTH, FINE)
    return Relief(stations, curves.cast_profile(truth_bore_caster(case), curve, stations, ANGLES))


@per_case
def relief_on_truth(case: Case) -> Relief:
    stations = truth_relief(case).station
    return Relief(stations, curves.cast_profile(bore_caster(case), curves.truth_curve(case), stations, ANGLES))


@per_case
def relief_on_path(case: Case) -> Relief:
    frame = hold_frame(case)
    stations = np.arange(frame.low + FINE / 2, frame.high, FINE)
    return Relief(stations, curves.cast_profile(bore_caster(case), sensor_path(case), stations, ANGLES, frame.middle))


def relief_cells(relief: Relief, values: Float[np.ndarray, "n m"] | None = None) -> Float[np.ndarray, "k s"]:
    """Return the medians of a relief, or of other values on its grid, in the cells of a map."""
    rows, columns = round(CELL / FINE), COLUMNS // SECTORS
    grid = relief.radius if values is None else values
    count = len(grid) // rows
    blocks = grid[: count * rows].reshape(count, rows, SECTORS, columns)
    return curves.nanmedian(blocks.transpose(0, 2, 1, 3).reshape(count, SECTORS, -1))


@per_case
def truth_map(case: Case) -> Unrolled:
    real, judged = truth_relief(case), relief_on_truth(case)
    offset = np.where(np.isfinite(judged.radius), judged.radius - real.radius, CAP)
    offset = np.where(np.isfinite(real.radius), np.clip(offset, -CAP, CAP), np.nan)
    low = float(real.station[0]) - FINE / 2
    return Unrolled(curves.truth_curve(case), (0.0, 0.0), low, relief_cells(real), relief_cells(real, offset))


# Shift along the tunnel by window, and which side is left, from the relief of the walls.

REACH = 0.40  # m; largest shift that is looked for: a quarter of a ring, so that the next one is not taken for it
_STEPS = round(REACH / FINE)  # shifts that are tried to either side, `FINE` apart
_DEEPEST = 0.10  # m; larger differences count as this
_LEAST_CONTRAST = 0.0008  # m that the best shift must fit better than a wrong one
_POINTS = 20_000
_FEWEST_CELLS = 50
_NUDGE = 0.01  # m


def shift_by_window(
    station: Float[np.ndarray, " n"],
    angle: Float[np.ndarray, " n"],
    radius: Float[np.ndarray, " n"],
    judged: Relief,
    starts: Float[np.ndarray, " k"],
    window: float,
) -> Float[np.ndarray, " k"]:
    """Return how far the relief of the candidate lies along the tunnel from that of points, by window, m.

    A wall that is out as a whole does not matter. NaN where the walls are too even to tell, or where no shift within
    `REACH` fits best. Points and relief are about the same middle: station, m, angle, rad, and distance from it, m.
    """
    order = np.argsort(station, kind="stable")
    station, radius = station[order], radius[order]
    turn = (angle[order] + np.pi) / (2.0 * np.pi)
    sector = (turn * SECTORS).astype(int) % SECTORS
    padded, cell = _cells_of(station, (turn * COLUMNS).astype(int) % COLUMNS, judged)
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
        result[k] = steps[best] * FINE + _vertex(errors, best)
    return result


def _cells_of(
    station: Float[np.ndarray, " n"], column: Int[np.ndarray, " n"], judged: Relief
) -> tuple[Float[np.ndarray, " c"], Int[np.ndarray, " n"]]:
    """Return the radii of a relief in one row, NaN before and behind it, and the place of each point in them.

    A point that moves by one step lies `COLUMNS` places on: all shifts of a window read the same places.
    """
    beyond = np.full((2 * _STEPS + 1, COLUMNS), np.nan)
    padded = np.concatenate([beyond, judged.radius, beyond])
    row = np.round((station - judged.station[0]) / FINE).astype(int)
    row = np.clip(row, -_STEPS - 1, len(judged.station) + _STEPS) + len(beyond)
    return padded.ravel(), row * COLUMNS + column


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
        gap = judged[cell + step * COLUMNS]
        np.subtract(apart + slope * (step * FINE), gap, out=gap)
        unknown = int(np.count_nonzero(np.isnan(gap)))
        if unknown < len(gap):
            total = np.fmin(np.abs(gap, out=gap), _DEEPEST, out=gap).sum()  # what is unknown counts as `_DEEPEST` here
            errors[k] = (total - unknown * _DEEPEST) / (len(gap) - unknown)
    return errors


def _line_by_sector(
    station: np.ndarray, values: np.ndarray, sector: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fits a straight line along the tunnel in each direction: mean station, mean value and slope."""
    count = np.maximum(np.bincount(sector, minlength=SECTORS), 1)
    middle = np.bincount(sector, station, SECTORS) / count
    level = np.bincount(sector, values, SECTORS) / count
    off = station - middle[sector]
    spread = np.bincount(sector, off**2, SECTORS)
    slope = np.bincount(sector, off * (values - level[sector]), SECTORS) / np.maximum(spread, 1e-9)
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
    return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5) * FINE) if bend > 0.0 else 0.0


def hold_shift(case: Case, starts: Float[np.ndarray, " k"], window: float) -> Float[np.ndarray, " k"]:
    """Return the shift of the candidate against the held-out returns on its walls, m; ahead positive."""
    frame = hold_frame(case)
    wall = (frame.cell >= 0) & ~is_floor(frame.angle) & np.isin(parts_hit(case), ("lining", "nail"))
    local = frame.local[wall]
    radius = np.hypot(local[:, 1], local[:, 2])
    return shift_by_window(local[:, 0], frame.angle[wall], radius, relief_on_path(case), starts, window)


def truth_shift(case: Case, starts: Float[np.ndarray, " k"], window: float) -> Float[np.ndarray, " k"]:
    """Return the shift of the candidate against the truth, m; ahead positive."""
    real = truth_relief(case)
    angle = ANGLES
    wall = ~is_floor(angle)
    station, around = np.meshgrid(real.station, angle[wall], indexing="ij")
    radius = real.radius[:, wall]
    known = np.isfinite(radius)
    return shift_by_window(station[known], around[known], radius[known], relief_on_truth(case), starts, window)


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
    angle = curves.section_angles(SECTORS)
    left = np.flatnonzero((np.abs(angle) < np.pi / 2) & ~is_floor(angle))
    mirror = np.argmin(np.abs(np.angle(np.exp(1j * (angle[None] - (np.pi - angle[left])[:, None])))), axis=1)
    half = (radius[:, left] - radius[:, mirror]) / 2.0
    template = _shift_template(curves.nanmedian(radius.T), angle)[left]
    known = np.isfinite(half) & np.isfinite(template)
    weight = np.where(known, template**2, 0.0).sum(axis=1)
    aside = np.where(known, half * template, 0.0).sum(axis=1) / np.maximum(weight, 1e-9)
    half = np.clip(half - aside[:, None] * template, -_DEEPEST, _DEEPEST)
    return half - curves.nanmedian(half.T)[None]


def _shift_template(radius: Float[np.ndarray, " m"], angle: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Return by how much each radius of a section grows if the section moves to the left, m/m."""
    known = np.isfinite(radius)
    x, y = radius[known] * np.cos(angle[known]) + _NUDGE, radius[known] * np.sin(angle[known])
    turned, grown = np.arctan2(y, x), np.hypot(x, y)
    order = np.argsort(turned)
    moved = np.interp(angle, turned[order], grown[order], period=2.0 * np.pi)
    return np.where(known, (moved - radius) / _NUDGE, np.nan)
