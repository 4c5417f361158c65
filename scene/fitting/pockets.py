"""Bolt pockets and ring joints, found on the wall unrolled.

A pocket is a hole in the returns that lie on the wall, with returns behind it. Seen along the tunnel its back is mostly
hidden by its own edge, so that one pocket says little about its depth or size. But the pockets of a lining come from
one mould, and all of them together say it well. They stand in rows along the bore, either side of every ring joint.
Pockets of turned rings stand in no rows and are not looked for.
"""

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.ndimage import maximum_filter, uniform_filter
from scipy.spatial import cKDTree

from scene.bore import POCKET
from scene.fitting import evidence
from scene.fitting.evidence import CLEAR, MIN_DEPTH, MODES, Holes
from scene.fitting.section import Sections
from scene.fitting.unroll import Grid

_ROW_FRACTION = 0.3  # of the fullest row, and of the places in a row
_PITCHES = (0.9, 2.1)  # widths of rings in use, m
_MIN_COHERENCE = 0.4  # length of the mean wave of a pitch: 0 by chance, 1 at one place of each ring
_NEAR_PLACE = 0.12  # m along the bore
_PLACES = 0.05  # m, step in which places in a ring are counted


def keep_rows(holes: Holes, columns: int, reach: float) -> Holes:
    """Return the holes in the rows that the clearest form; `reach` is half the width of a row, in columns."""
    clear = np.bincount(holes.column[holes.score > CLEAR], minlength=columns).astype(float)
    window = max(int(2 * reach) | 1, 3)
    filled = uniform_filter(clear, window, mode="wrap") * window
    fullest = maximum_filter(filled, 2 * window + 1, mode="wrap")
    peaks = np.flatnonzero((filled == fullest) & (filled > max(_ROW_FRACTION * filled.max(), 2)))
    return holes.where(_near_columns(holes, peaks, columns, reach))


def add_pattern(faint: Holes, clear: Holes, grid: Grid, reach: float) -> Holes:
    """Adds the faint holes that stand where the pattern of the clear holes has a pocket.

    Holes faint in themselves, as pockets are that the scanner looks at head on, make a row where most of its places
    either side of the joints hold one; chance would fill about a quarter of them. `clear` are the clear holes in rows,
    and `reach` is half the width of a row, in columns.
    """
    station = (clear.row + 0.5) * grid.step
    joints = find_ring_joints(station, grid.rows * grid.step)
    if len(joints) < 2:
        return clear
    pitch = float(np.median(np.diff(joints)))
    in_place = faint.where(_stand_in_places(faint, station, joints[0], pitch, grid.step))
    window = max(int(2 * reach) | 1, 3)
    filled = uniform_filter(np.bincount(in_place.column, minlength=grid.columns).astype(float), window, mode="wrap")
    everything = uniform_filter(np.bincount(faint.column, minlength=grid.columns).astype(float), window, mode="wrap")
    places = 2 * len(joints)
    peaks = np.flatnonzero(
        (filled == maximum_filter(filled, 2 * window + 1, mode="wrap"))
        & (filled * window > 2 * _ROW_FRACTION * places)
        & (filled > 0.6 * everything)
    )
    more = in_place.where(_near_columns(in_place, peaks, grid.columns, reach))
    cells = np.concatenate([np.stack([h.row, h.column], axis=1) for h in (clear, more)])
    _, first = np.unique(cells, axis=0, return_index=True)
    score = np.concatenate([clear.score, more.score])
    return Holes(cells[first, 0], cells[first, 1], score[first])


def _stand_in_places(
    holes: Holes, station: np.ndarray, joint: float, pitch: float, step: float
) -> Bool[np.ndarray, " p"]:
    """True for holes as far from their joint as the clear ones, within `_NEAR_PLACE`."""
    bins = max(round(pitch / _PLACES), 4)
    known = np.bincount(((station - joint) % pitch / pitch * bins).astype(int) % bins, minlength=bins).astype(float)
    spread = uniform_filter(known, 3, mode="wrap")
    top = maximum_filter(spread, 5, mode="wrap")
    places = np.flatnonzero((spread == top) & (spread > _ROW_FRACTION * spread.max()))
    at = ((holes.row + 0.5) * step - joint) % pitch
    apart = np.abs(at[:, None] - (places[None] + 0.5) * pitch / bins)
    return np.minimum(apart, pitch - apart).min(axis=1) < _NEAR_PLACE


def _near_columns(holes: Holes, peaks: np.ndarray, columns: int, reach: float) -> Bool[np.ndarray, " p"]:
    if not len(peaks):
        return np.zeros(len(holes.row), bool)
    apart = np.abs((holes.column[:, None] - peaks[None] + columns / 2) % columns - columns / 2).min(axis=1)
    return apart <= max(reach, 1.5)


def find_ring_joints(station: Float[np.ndarray, " p"], length: float) -> Float[np.ndarray, " r"]:
    """Finds the stations of the ring joints between the pockets, m; empty where no pitch fits."""
    step = _PITCHES[0] ** 2 / (8 * max(length, 1.0))
    pitch = np.arange(*_PITCHES, step)
    wave = np.exp(2j * np.pi * station[None] / pitch[:, None]).mean(axis=1)
    best = int(np.argmax(np.abs(wave)))
    if np.abs(wave[best]) < _MIN_COHERENCE:
        return np.empty(0)
    phase = np.angle(wave[best]) / (2 * np.pi) * pitch[best] % pitch[best]
    return np.arange(phase, length, pitch[best])


_HOLE = (4, 3)  # cells of 5 cm × 1°
_AROUND = (16, 13)  # cells about a hole that it is compared with
_EXPECTED = (31, 21)  # cells over which the wall is alike
_PEAK_WINDOW = (7, 7)  # cells of which one is the middle of a hole
_WEAK, _FAINT = 0.22, 0.12  # scores of holes that may be pockets, by themselves and by their place
_MIN_EXPECTED = 0.2  # points a cell; with fewer on the wall a hole says nothing
FLOOR_MARGIN = 0.45  # m above the floor
_ROW_WIDTH = 0.15  # m
_MIN_POCKETS = 6  # with fewer there is no lining
_MIN_SEEN = 0.6  # of the wall
_NOISE_FRACTION = 0.25  # of the depth
_RIB = 0.02  # least wall left between two pockets, and before a mouth, m
_OPEN_RIM, _USUAL_RIM = 0.35, 0.15  # part of the wall missing around one hole that is no pocket, and around the usual


def find_pockets(sections: Sections) -> tuple[Shaped[np.ndarray, " p"], Float[np.ndarray, " r"]]:
    """Finds the pockets that a survey shows, of `scene.bore.POCKET`, and the ring joints between them, m.

    Position is each pocket's own; length, width and depth are common to all. Holes that stand in no rows, have no rims,
    or could be chance are no pockets: both results are empty then.
    """
    expected = uniform_filter(sections.support, _EXPECTED, mode=MODES)
    fraction = sections.support / np.maximum(expected, 1e-9)
    # Fraction of the wall's returns that each cell lacks against those around it: 0 none, 1 all.
    deficit = np.where((expected > _MIN_EXPECTED) & ~_near_floor(sections), np.clip(1 - fraction, -1, 1), 0.0)
    faint = _find_holes(deficit, sections)
    weak = faint.where(faint.score > _WEAK)
    reach = _ROW_WIDTH / (2 * np.pi * np.median(sections.radius) / sections.grid.columns)
    rows = keep_rows(weak, sections.grid.columns, reach)
    nothing = np.empty(0, POCKET), np.empty(0)
    if len(rows.row) < _MIN_POCKETS:
        return nothing
    pockets = _measure_pockets(deficit, sections, add_pattern(faint, rows, sections.grid, reach))
    if not len(pockets):
        return nothing
    joints = find_ring_joints(pockets["station"], sections.grid.rows * sections.grid.step)
    radius = float(np.median(sections.radius))
    return (pockets, joints) if evidence.more_than_chance(pockets, joints, _PITCHES, radius) else nothing


def _keep_likely(deficit: np.ndarray, sections: Sections, holes: Holes) -> tuple[Holes, Float[np.ndarray, " k"]]:
    """Return the holes that are likelier pockets like the clear ones than wall, and the odds of it, as a logarithm."""
    grid, clear = sections.grid, holes.score > CLEAR
    row, column = evidence.refine_positions(deficit, sections, holes)
    middle = Holes(np.rint(row).astype(np.intp), np.rint(column).astype(np.intp), holes.score)
    size = evidence.common_size(deficit, sections, holes, evidence.slopes(sections, holes))
    odds = evidence.pocket_over_wall(sections, middle, size)
    if clear.any():
        station = (row + 0.5) * grid.step
        joints = find_ring_joints(station[clear], grid.rows * grid.step)
        odds = evidence.odds_by_place(odds, station, float(np.median(np.diff(joints)))) if len(joints) > 1 else odds
    return holes.where(odds >= 0.0), odds[odds >= 0.0]


def _measure_pockets(deficit: np.ndarray, sections: Sections, holes: Holes) -> Shaped[np.ndarray, " p"]:
    """Return the pockets that holes are, of `scene.bore.POCKET`; none where their rims are open, or few are left."""
    holes, odds = _keep_likely(deficit, sections, holes)
    if len(holes.row) < _MIN_POCKETS:
        return np.empty(0, POCKET)
    grid = sections.grid
    row, column = evidence.refine_positions(deficit, sections, holes)
    station, angle = grid.start + (row + 0.5) * grid.step, -np.pi + (column + 0.5) * 2 * np.pi / grid.columns
    slope = evidence.slopes(sections, holes)
    length, width = evidence.common_size(deficit, sections, holes, slope)
    depth = evidence.common_depth(sections, holes, slope)
    radius = float(np.median(sections.radius))
    rim = evidence.open_rims(deficit, grid, row, column, (length, width), radius)
    end = 0.5 * length + _RIB
    inside = (station > grid.start + end) & (station < grid.start + grid.rows * grid.step - end)
    if np.median(rim) > _USUAL_RIM or (inside & (rim < _OPEN_RIM)).sum() < _MIN_POCKETS:
        return np.empty(0, POCKET)
    inside &= rim < _OPEN_RIM
    pockets = np.zeros(int(inside.sum()), POCKET)
    pockets["station"], pockets["angle"] = (station - grid.start)[inside], angle[inside]
    pockets["length"], pockets["width"], pockets["depth"] = length, width, depth
    pockets["confidence"], pockets["measured"] = np.clip(holes.score[inside] / CLEAR, 0, 1), True
    return pockets[_drop_overlaps(pockets, odds[inside], radius)]


def _drop_overlaps(
    pockets: Shaped[np.ndarray, " p"], odds: Float[np.ndarray, " p"], radius: float
) -> Bool[np.ndarray, " p"]:
    """Pockets to keep so that none overlap in a bore of a radius, m; of two that do, the one likelier wall goes.

    `odds` are those of each to be a pocket, as a logarithm.
    """
    length, width = float(pockets["length"][0]) + _RIB, float(pockets["width"][0]) + _RIB
    place = np.column_stack([pockets["station"] / length, pockets["angle"] * radius / width])
    keep = np.ones(len(pockets), bool)
    for i, j in sorted(cKDTree(place).query_pairs(1.0, p=np.inf)):
        if keep[i] and keep[j]:
            keep[i if odds[i] < odds[j] else j] = False
    return keep


def could_show_pockets(sections: Sections, depth: float) -> bool:
    """Return whether pockets of a depth, m, would be found in this cloud, were there any."""
    near = uniform_filter(sections.support, _EXPECTED, mode=MODES)[~_near_floor(sections)]
    seen = float(np.mean(near > _MIN_EXPECTED)) if near.size else 0.0
    noise = float(np.median(sections.spread))
    return seen > _MIN_SEEN and noise < _NOISE_FRACTION * depth


def _near_floor(sections: Sections) -> np.ndarray:
    """Cells of a flat floor and its corners, where track and clutter make holes of their own."""
    if not sections.flat_floor:
        return np.zeros(sections.radius.shape, bool)
    grid = sections.grid
    lowest = (sections.radius * np.sin(grid.angle)).min(axis=1, keepdims=True)
    return sections.radius * np.sin(grid.angle) - lowest < FLOOR_MARGIN


def _find_holes(deficit: np.ndarray, sections: Sections) -> Holes:
    score = uniform_filter(deficit, _HOLE, mode=MODES) - uniform_filter(deficit, _AROUND, mode=MODES)
    behind = maximum_filter(sections.deepest, (9, 5), mode=MODES)
    peak = (score == maximum_filter(score, _PEAK_WINDOW, mode=MODES)) & (score > _FAINT) & (behind > MIN_DEPTH)
    row, column = np.nonzero(peak)
    return Holes(row, column, score[row, column])
