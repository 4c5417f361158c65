"""The unrolled lining: depth maps, the grid of the rings, pockets."""

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import convolve, label, map_coordinates
from scipy.signal import correlate, find_peaks
from scipy.spatial import cKDTree
from skimage.measure import regionprops

from benchmarks.fidelity.case import Case, per_case, per_hold, per_reference, per_truth
from benchmarks.fidelity.derive import curve as curves
from benchmarks.fidelity.derive.axis import hold_local, hold_points, lining_caster, reference_curve
from benchmarks.fidelity.derive.beams import cast_beams, points_at
from benchmarks.fidelity.derive.sections import COLUMNS, ROW, Radii, cast_radii, truth_radii

_COARSE_ROWS = 5  # rows between those that the smooth section is taken from
_LARGEST_DEPTH = 0.40  # m; what lies farther off the smooth section is no lining
_WALL_FOOT = 0.30  # m; below is floor
_BLUR = np.ones((3, 3))


@dataclass(frozen=True)
class Unrolled:
    """Map of depths of the unrolled lining."""

    station: Float[np.ndarray, " n"]  # Stations of the rows, m
    angle: Float[np.ndarray, " m"]  # Angles of the columns, from left towards up, rad
    # Depth behind the smooth section along the ray from the axis, m; NaN where not known
    depth: Float[np.ndarray, "n m"]
    smooth: Float[np.ndarray, " m"]  # Radius of the typical smooth section, m
    wall: Bool[np.ndarray, " m"]  # Columns that are wall or roof, not floor

    @property
    def arc(self) -> Float[np.ndarray, " m"]:
        """Length along the section, from the middle of the floor, m, at each column."""
        return np.cumsum(self.pitch)

    @property
    def pitch(self) -> Float[np.ndarray, " m"]:
        """Length along the section that a column covers, m."""
        return self.smooth * 2 * np.pi / COLUMNS / self.slant

    @property
    def slant(self) -> Float[np.ndarray, " m"]:
        """Cosine between the ray and the normal of the section at each column, at least 0.3."""
        change = (np.roll(self.smooth, -2) - np.roll(self.smooth, 2)) / (8 * np.pi / COLUMNS)
        return np.maximum(self.smooth / np.hypot(self.smooth, change), 0.3)


def _make_map(station: np.ndarray, radius: np.ndarray, smooth: np.ndarray) -> Unrolled:
    angle = curves.section_angles(COLUMNS)
    depth = radius - smooth
    depth = np.where(np.abs(depth) < _LARGEST_DEPTH, depth, np.nan)
    typical = curves.nanmedian(smooth.T)
    height = typical * np.sin(angle)
    wall = np.isfinite(typical) & (height > np.nanmin(height) + _WALL_FOOT)
    return Unrolled(station, angle, depth, np.where(np.isfinite(typical), typical, np.nanmedian(typical)), wall)


def map_of_radii(radii: Radii) -> Unrolled:
    """Return a map from a table of radii; its smooth section is the running median over 1.5 m."""
    coarse = curves.running_median(radii.radius[::_COARSE_ROWS], _COARSE_ROWS * ROW)
    return _make_map(radii.station, radii.radius, _stretch(coarse, len(radii.station), _COARSE_ROWS))


def _stretch(coarse: Float[np.ndarray, "c m"], rows: int, step: int, first: float = 0.0) -> Float[np.ndarray, "n m"]:
    place = np.clip((np.arange(rows) - first) / step, 0, len(coarse) - 1)
    below = np.minimum(place.astype(int), max(len(coarse) - 2, 0))
    fraction = (place - below)[:, None]
    return (1 - fraction) * coarse[below] + fraction * coarse[np.minimum(below + 1, len(coarse) - 1)]


@per_case
def lining_map(case: Case) -> Unrolled:
    return map_of_radii(cast_radii(reference_curve(case), lining_caster(case)))


@per_truth
def truth_map(case: Case) -> Unrolled:
    return map_of_radii(truth_radii(case))


def hold_map(case: Case) -> Unrolled:
    """Return the map of the held-out recording, from the same axis; the mean of the returns in each cell."""
    return _hold_map(case, reference_curve(case))


@per_hold
def _hold_map(case: Case, curve: curves.Curve) -> Unrolled:
    return map_of_points(curve, hold_local(case) if case.truth is None else curve.local(hold_points(case)))


def map_of_points(curve: curves.Curve, local: Float[np.ndarray, "k 3"]) -> Unrolled:
    rows = max(int(curve.length / ROW), 2)
    step = curve.length / rows
    row = (local[:, 0] - curve.station[0]) / step
    angle = (np.arctan2(local[:, 2], local[:, 1]) + np.pi) / (2 * np.pi) * COLUMNS
    kept = (row >= 0) & (row < rows)
    row, angle, radius = row[kept], angle[kept], np.hypot(local[kept, 1], local[kept, 2])
    column = np.minimum(angle.astype(int), COLUMNS - 1)
    coarse_rows = -(-rows // _COARSE_ROWS)
    group = (row / _COARSE_ROWS).astype(int) * COLUMNS + column
    coarse = curves.grouped_median(group, radius, coarse_rows * COLUMNS).reshape(coarse_rows, COLUMNS)
    coarse = curves.running_median(coarse, _COARSE_ROWS * ROW)
    smooth = _stretch(coarse, rows, _COARSE_ROWS, (_COARSE_ROWS - 1) / 2)
    # Between columns the section slants: a return is compared with the section at its own angle.
    padded = np.concatenate([smooth[:, -1:], smooth, smooth[:, :1]], axis=1)
    expected = map_coordinates(padded, [np.minimum(row, rows - 1), angle + 0.5], order=1, mode="nearest")
    depth = radius - expected
    good = np.isfinite(depth) & (np.abs(depth) < _LARGEST_DEPTH)
    cell = row.astype(int)[good] * COLUMNS + column[good]
    count = np.bincount(cell, minlength=rows * COLUMNS)
    total = np.bincount(cell, depth[good], rows * COLUMNS)
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(rows, COLUMNS)
    return _make_map(curve.station[0] + (np.arange(rows) + 0.5) * step, smooth + mean, smooth)


@per_case
def observed_map(case: Case) -> Unrolled:
    """Return the candidate's map as the held-out beams would show it: the same gaps and shadows."""
    points = points_at(case, cast_beams(case).range)
    return map_of_points(reference_curve(case), reference_curve(case).local(points[np.isfinite(points).all(axis=1)]))


def both_maps(case: Case) -> tuple[Unrolled, Unrolled]:
    """Return the maps to compare: candidate and truth, else candidate and recording by the same beams."""
    return (lining_map(case), truth_map(case)) if case.truth is not None else (observed_map(case), hold_map(case))


def blur(depth: Float[np.ndarray, "n m"], known: Bool[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
    """Return the mean over the known cells among nine, m; NaN where there is none."""
    usable = known & np.isfinite(depth)
    weight = convolve(usable.astype(float), _BLUR, mode="constant")
    total = convolve(np.where(usable, depth, 0.0), _BLUR, mode="constant")
    return np.where(weight > 0, total / np.maximum(weight, 1.0), np.nan)


@per_case
def paired_depths(case: Case) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return stations, and depths of candidate and recording in the cells that beams show of both, m.

    Both are averaged over the same cells of three by three, so that range noise of single returns does not decide.
    """
    judged, hold = observed_map(case), hold_map(case)
    rows = min(len(judged.station), len(hold.station))
    known = np.isfinite(hold.depth[:rows]) & np.isfinite(judged.depth[:rows]) & hold.wall & judged.wall
    both = [blur(side.depth[:rows], known)[known] for side in (judged, hold)]
    return np.repeat(hold.station[:rows], known.sum(axis=1)), both[0], both[1]


# The grid of the rings: axial pitch, phase along the tunnel, rows around the section.

RING_LAGS = (0.5, 4.0)  # m; pitch of rings
RING_BAND = 0.30  # of the pitch to either side in which the candidate's is looked for
PITCH_HARMONICS = 4
PHASE_PITCHES = 4.0  # in a window of phase
_RELIEF = 0.03  # m; less is roughness
_FAINT = 1e-4  # m; a mean relief below it is no grid
_HIGH_PEAK = 0.75  # of the highest peak
_PITCH_STEPS = 2001
_ROW_HEIGHT = 0.25  # of the highest row


def relief(unrolled: Unrolled) -> Float[np.ndarray, "n m"]:
    """Return the depth of recesses, m; 0 on plain wall, on the floor and where nothing is known."""
    depth = np.nan_to_num(unrolled.depth)
    return np.where((depth > _RELIEF) & unrolled.wall, depth, 0.0)


def relief_along(unrolled: Unrolled, axis: int = 1) -> Float[np.ndarray, " n"]:
    """Return the mean relief by station, or by direction with `axis` 0, where the wall is known, m."""
    known = (np.isfinite(unrolled.depth) & unrolled.wall).sum(axis=axis)
    return relief(unrolled).sum(axis=axis) / np.maximum(known, 1)


def coarse_pitch(signal: Float[np.ndarray, " n"]) -> float | None:
    """Return the lag of the first high peak of the autocorrelation, m; `None` without relief."""
    if signal.mean() < _FAINT:
        return None
    centred = signal - signal.mean()
    full = correlate(centred, centred, mode="full")[len(centred) - 1 :]
    full /= np.maximum(len(centred) - np.arange(len(centred)), 1)
    low, high = (min(int(lag / ROW), len(full) - 1) for lag in RING_LAGS)
    peaks, _ = find_peaks(full[low:high])
    if not len(peaks):
        return None
    height = full[low + peaks]
    return float((low + peaks[np.argmax(height > _HIGH_PEAK * height.max())]) * ROW)


def ring_pitch(unrolled: Unrolled, near: float, band: float) -> float | None:
    """Return the pitch near another whose comb of four harmonics is strongest, m; `None` without relief."""
    signal = relief_along(unrolled)
    if signal.mean() < _FAINT:
        return None
    tried = near * np.linspace(1 - band, 1 + band, _PITCH_STEPS)
    centred = (signal - signal.mean()) * np.hanning(len(signal))
    return float(tried[np.argmax(_comb_power(centred, unrolled.station, 1.0 / tried))])


def _comb_power(signal: np.ndarray, station: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    """Return the power of a signal at some frequencies and their harmonics together."""
    power = []
    for part in np.array_split(frequency, max(len(frequency) // 100, 1)):
        wave = np.exp(-2j * np.pi * part[:, None] * station)
        harmonics = itertools.accumulate([wave] * PITCH_HARMONICS, np.multiply)
        power.append(sum(np.abs(one @ signal) ** 2 for one in harmonics))
    return np.concatenate(power)


@per_reference
def reference_pitch(case: Case) -> float | None:
    """Return the pitch of the reference's rings, m; `None` where it shows none."""
    unrolled = truth_map(case) if case.truth is not None else hold_map(case)
    coarse = coarse_pitch(relief_along(unrolled))
    return None if coarse is None else ring_pitch(unrolled, coarse, 0.1)


def ring_phases(unrolled: Unrolled, length: float) -> Float[np.ndarray, " w"]:
    """Return the phase of a pitch in overlapping windows, rad; NaN in a window without relief."""
    signal = relief_along(unrolled)
    size = int(PHASE_PITCHES * length / ROW)
    result = []
    for start in range(0, max(len(signal) - size, 0) + 1, max(size // 2, 1)):
        part, station = signal[start : start + size], unrolled.station[start : start + size]
        value = (np.exp(-2j * np.pi * np.array([[1.0 / length]]) * station) @ (part - part.mean()))[0]
        result.append(np.angle(value) if part.mean() > _FAINT else np.nan)
    return np.array(result)


def pocket_rows(unrolled: Unrolled, arc: Float[np.ndarray, " m"]) -> Float[np.ndarray, " r"]:
    """Return the positions along the section of rows of recesses, m."""
    signal = relief_along(unrolled, axis=0)
    smooth = np.convolve(np.concatenate([signal[-2:], signal, signal[:2]]), np.ones(5) / 5, mode="valid")
    if smooth.max() < _FAINT:
        return np.zeros(0)
    peaks, _ = find_peaks(smooth, height=_ROW_HEIGHT * smooth.max(), distance=4)
    return arc[peaks]


# Pockets: those that a map shows, those of the truth, and the pairs of both.

POCKET_MATCH = 0.15  # m
DEEP_POCKET = (0.06, 0.008)  # m behind the smooth section, about half a pocket, and m² of it
GRAZED_POCKET = (0.025, 0.004)  # the same of what beams show: most end on a pocket's far side and miss its bottom
_LARGEST_POCKET = 0.20  # m²
_EIGHT = np.ones((3, 3), int)


@dataclass(frozen=True)
class Pockets:
    """Recesses of the lining."""

    station: Float[np.ndarray, " p"]  # Station, m
    arc: Float[np.ndarray, " p"]  # Position along the section, m
    depth: Float[np.ndarray, " p"]  # Depth normal to the wall, m
    area: Float[np.ndarray, " p"]  # Area of the opening, m²

    def __len__(self) -> int:
        return len(self.station)

    @property
    def place(self) -> Float[np.ndarray, "p 2"]:
        """Position on the unrolled wall, m, `(p, 2)`."""
        return np.column_stack([self.station, self.arc])


def detect_pockets(
    unrolled: Unrolled, depth: Float[np.ndarray, "n m"], arc: Float[np.ndarray, " m"], least: tuple[float, float]
) -> Pockets:
    """Finds connected cells that are deep enough and together have the area of a pocket.

    Args:
        unrolled: Map of the cells.
        depth: Depth of the cells, m.
        arc: Position along the section at each column, m; that of the reference, so that both sides are measured alike.
        least: Least depth, m, and area, m².
    """
    deep = (np.nan_to_num(depth) * unrolled.slant > least[0]) & unrolled.wall
    size = np.where(unrolled.wall, unrolled.pitch, 0.0) * ROW
    pockets = []
    for region in regionprops(label(deep, _EIGHT)[0]):
        rows, columns = region.coords.T
        area = float(size[columns].sum())
        if least[1] < area < _LARGEST_POCKET:
            values = depth[rows, columns] * unrolled.slant[columns]
            bottom = float(np.median(values[values >= np.median(values)]))
            pockets.append((unrolled.station[rows].mean(), arc[columns].mean(), bottom, area))
    return Pockets(*np.array(pockets, float).reshape(-1, 4).T)


def shown_pockets(unrolled: Unrolled, arc: Float[np.ndarray, " m"]) -> Pockets:
    return detect_pockets(unrolled, blur(unrolled.depth, np.isfinite(unrolled.depth)), arc, GRAZED_POCKET)


@per_case
def judged_pockets(case: Case) -> Pockets:
    """Return the pockets of the candidate's lining; against a recording those that its beams would have shown."""
    judged, arc = both_maps(case)[0], reference_arc(case)
    return shown_pockets(judged, arc) if case.truth is None else detect_pockets(judged, judged.depth, arc, DEEP_POCKET)


@per_case
def reference_pockets(case: Case) -> Pockets:
    """Return the open pockets of the truth; otherwise those that the held-out recording shows."""
    if case.truth is None:
        return shown_pockets(hold_map(case), reference_arc(case))
    rows = [pocket for pocket in case.truth.furniture.get("pockets", ()) if pocket["open"]]
    if not rows:
        return Pockets(*np.zeros((4, 0)))
    local = curves.truth_curve(case).local(np.array([row["position"] for row in rows]) - case.truth.origin)
    angle = np.arctan2(local[:, 2], local[:, 1])
    arc = reference_arc(case)[np.minimum(((angle + np.pi) / (2 * np.pi) * COLUMNS).astype(int), COLUMNS - 1)]
    depth = np.array([row["depth"] for row in rows], float)
    return Pockets(local[:, 0], arc, depth, np.array([row["length"] * row["width"] for row in rows], float))


def reference_arc(case: Case) -> Float[np.ndarray, " m"]:
    """Return the length along the reference's section at each column, m: both sides are measured by it."""
    return both_maps(case)[1].arc


@per_case
def matched_pockets(case: Case) -> Int[np.ndarray, "k 2"]:
    """Return pairs (judged, reference) of mutual nearest pockets at most 15 cm apart on the unrolled wall."""
    judged, reference = judged_pockets(case), reference_pockets(case)
    if not len(judged) or not len(reference):
        return np.zeros((0, 2), int)
    apart, there = cKDTree(reference.place).query(judged.place)
    back = cKDTree(judged.place).query(reference.place)[1]
    mutual = (back[there] == np.arange(len(judged))) & (apart <= POCKET_MATCH)
    return np.column_stack([np.flatnonzero(mutual), there[mutual]])
