"""Bolt pockets and ring joints, found on the wall rolled out flat.

A pocket is a hole in the returns that lie on the wall, with returns behind it. Seen along the tunnel its back is mostly
hidden by its own edge, so that one pocket says little about its depth or size. But the pockets of a lining come from
one mould, and all of them together say it well. They stand in rows along the bore, either side of every ring joint.
Pockets of turned rings stand in no rows and are not looked for.

Ring joints show by steps, too: segments stand a few millimetres apart. One step is lost in the noise. But rings are
alike in length, so that the mean square of all steps, folded to one ring, peaks at the joint, whatever segments and
pockets do. A joint is known where that place beats every other, ring by ring, by more than chance.
"""

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.ndimage import binary_dilation, maximum_filter, uniform_filter, uniform_filter1d
from scipy.spatial import cKDTree

from scene.bore import POCKET
from scene.fitting.evidence import more_than_chance, odds_by_place, open_rims, pocket_over_wall
from scene.fitting.mould import (
    CLEAR,
    MIN_DEPTH,
    MODES,
    Holes,
    common_depth,
    common_size,
    refine_positions,
    slopes,
)
from scene.fitting.section import Sections
from scene.fitting.unroll import Grid

_BEFORE = 0.4  # m before and behind a place, over which the wall is averaged
_STEPS_AROUND = 9  # columns over which steps are averaged: far less than a segment
_MIN_WEIGHT = 6.0  # returns before and behind, at most 50 of a cell
_MOST = 0.02  # m, more than segments stand apart
_BIN = 0.05  # m along a ring
_RIVAL = 0.3  # m from the joint: other places in a ring
_MIN_T = 4.0  # Student's t of the joint against each of them
_PEAK = 0.15  # m about the fullest place, over which it is centred


def find_joints_by_steps(
    sections: Sections, hole: Bool[np.ndarray, "rows cols"], pitch: float
) -> Float[np.ndarray, " r"]:
    """Finds the stations of the ring joints from the start of the grid, m; empty where steps do not tell them.

    `hole` are cells of pockets and other holes, whose rims would be steps; `pitch` is the length of a ring, m.
    """
    grid = sections.grid
    station, step = _mean_square_steps(sections, ~hole)
    bins = max(round(pitch / _BIN), 8)
    ring = np.floor(station / pitch).astype(int)
    place = np.minimum((np.mod(station, pitch) / pitch * bins).astype(int), bins - 1)
    rows = ring.max(initial=-1) + 1
    cell, known = ring * bins + place, np.isfinite(step)
    count = np.bincount(cell[known], minlength=rows * bins).reshape(rows, bins)
    total = np.bincount(cell[known], step[known], rows * bins).reshape(rows, bins)
    if rows < 2 or not (count.sum(axis=0) > 0).all():
        return np.empty(0)
    mean = total.sum(axis=0) / count.sum(axis=0)
    best = int(np.argmax(mean))
    apart = (np.mod(np.arange(bins) - best + bins / 2, bins) - bins / 2) * pitch / bins
    each = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    if min(_student(each[:, best] - each[:, rival]) for rival in np.flatnonzero(np.abs(apart) >= _RIVAL)) < _MIN_T:
        return np.empty(0)
    near = np.abs(apart) < _PEAK
    above = np.maximum(mean[near] - np.median(mean), 0.0)
    joint = (best + 0.5) * pitch / bins + float(above @ apart[near] / above.sum())
    return np.arange(joint % pitch, grid.rows * grid.step, pitch)


def _student(difference: Float[np.ndarray, " r"]) -> float:
    """Return Student's t of a mean that differs from 0; 0 for fewer than three values."""
    difference = difference[np.isfinite(difference)]
    if len(difference) < 3:
        return 0.0
    return float(difference.mean() / (difference.std(ddof=1) + 1e-12) * np.sqrt(len(difference)))


def _mean_square_steps(
    sections: Sections, use: Bool[np.ndarray, "rows cols"]
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, " e"]]:
    """Return edges between rows, m from the start of the grid, and the mean square step of the wall there, m².

    It is NaN where too little was seen.
    """
    n = round(_BEFORE / sections.grid.step)
    weight = np.where(sections.inlier & use, np.minimum(sections.weight, 50.0), 0.0)
    wall = sections.radius + sections.residual
    padded = [np.pad(field.cumsum(axis=0), ((1, 0), (0, 0))) for field in (weight, weight * wall)]
    edge = np.arange(n, sections.grid.rows - n + 1)
    before, ahead = ([field[e + n] - field[e] for field in padded] for e in (edge - n, edge))
    seen = (before[0] > _MIN_WEIGHT) & (ahead[0] > _MIN_WEIGHT)
    step = ahead[1] / np.maximum(ahead[0], 1e-9) - before[1] / np.maximum(before[0], 1e-9)
    sure = np.where(seen, before[0] * ahead[0] / np.maximum(before[0] + ahead[0], 1e-9), 0.0)
    total = uniform_filter1d(sure, _STEPS_AROUND, axis=1, mode="wrap")
    around = uniform_filter1d(sure * step, _STEPS_AROUND, axis=1, mode="wrap") / np.maximum(total, 1e-9)
    known = total > _MIN_WEIGHT
    square = np.where(known, np.clip(around, -_MOST, _MOST) ** 2, 0.0).sum(axis=1)
    enough = known.sum(axis=1) > sections.grid.columns / 4
    return edge * sections.grid.step, np.where(enough, square / np.maximum(known.sum(axis=1), 1), np.nan)


_ROW_SHARE = 0.3  # of the fullest row, and of the places in a row
_PITCHES = (0.9, 2.1)  # widths of rings in use, m
_MIN_COHERENCE = 0.4
_NEAR_PLACE = 0.12  # m along the bore
_PLACES = 0.05  # m, step in which places in a ring are counted


def keep_rows(holes: Holes, columns: int, reach: float) -> Holes:
    """Return the holes in the rows that the clearest form; `reach` is half the width of a row, in columns."""
    clear = np.bincount(holes.column[holes.score > CLEAR], minlength=columns).astype(float)
    window = max(int(2 * reach) | 1, 3)
    filled = uniform_filter(clear, window, mode="wrap") * window
    fullest = maximum_filter(filled, 2 * window + 1, mode="wrap")
    peaks = np.flatnonzero((filled == fullest) & (filled > max(_ROW_SHARE * filled.max(), 2)))
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
        & (filled * window > 2 * _ROW_SHARE * places)
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
    places = np.flatnonzero((spread == maximum_filter(spread, 5, mode="wrap")) & (spread > _ROW_SHARE * spread.max()))
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
_AROUND = (16, 13)
_EXPECTED = (31, 21)
_PEAK_WINDOW = (7, 7)
_WEAK, _FAINT = 0.22, 0.12
_MIN_EXPECTED = 0.2  # points a cell; with fewer on the wall a hole says nothing
FLOOR_MARGIN = 0.45  # m above the floor
_ROW_WIDTH = 0.15  # m
_MIN_POCKETS = 6
_MIN_SEEN = 0.6  # of the wall
_NOISE_SHARE = 0.25  # of the depth
_RIB = 0.02  # least wall left between two pockets, and before a mouth, m
_OPEN_RIM, _USUAL_RIM = 0.35, 0.15  # share of the wall missing around one hole that is no pocket, and around the usual
_RIMS = (11, 9)  # cells about the middle of a hole that are it or its rim
_THROUGH = 0.05  # of the pockets
_SAME_JOINT = 0.1  # m


def find_pockets(sections: Sections) -> tuple[Shaped[np.ndarray, " p"], Float[np.ndarray, " r"]]:
    """Finds the pockets that a survey shows, of `scene.bore.POCKET`, and the ring joints between them, m.

    Position is each pocket's own; length, width and depth are common to all. Holes that stand in no rows, have no rims,
    or could be chance are no pockets: both results are empty then.
    """
    deficit = _deficit(sections)
    faint = _find_holes(deficit, sections)
    weak = faint.where(faint.score > _WEAK)
    reach = _ROW_WIDTH / (2 * np.pi * np.median(sections.radius) / sections.grid.columns)
    rows = keep_rows(weak, sections.grid.columns, reach)
    pockets, joints = _pockets_in_rows(deficit, sections, faint, rows, reach)
    if not len(pockets):
        return pockets, joints
    return pockets, _correct_joints(joints, _joints_by_steps(sections, weak, pockets, float(np.diff(joints).mean())))


def _pockets_in_rows(
    deficit: np.ndarray, sections: Sections, faint: Holes, rows: Holes, reach: float
) -> tuple[Shaped[np.ndarray, " p"], Float[np.ndarray, " r"]]:
    """Return the pockets in rows, and the joints in the middle of those either side; none where it could be chance."""
    nothing = np.empty(0, POCKET), np.empty(0)
    if len(rows.row) < _MIN_POCKETS:
        return nothing
    pockets = _measure_pockets(deficit, sections, add_pattern(faint, rows, sections.grid, reach))
    if not len(pockets):
        return nothing
    joints = find_ring_joints(pockets["station"], sections.grid.rows * sections.grid.step)
    radius = float(np.median(sections.radius))
    return (pockets, joints) if more_than_chance(pockets, joints, _PITCHES, radius) else nothing


def _keep_likely(deficit: np.ndarray, sections: Sections, holes: Holes) -> tuple[Holes, Float[np.ndarray, " k"]]:
    """Return the holes that are likelier pockets like the clear ones than wall, and the odds of it, as a logarithm."""
    grid, clear = sections.grid, holes.score > CLEAR
    row, column = refine_positions(deficit, sections, holes)
    middle = Holes(np.rint(row).astype(np.intp), np.rint(column).astype(np.intp), holes.score)
    odds = pocket_over_wall(sections, middle, common_size(deficit, sections, holes, slopes(sections, holes)))
    if clear.any():
        station = (row + 0.5) * grid.step
        joints = find_ring_joints(station[clear], grid.rows * grid.step)
        odds = odds_by_place(odds, station, float(np.median(np.diff(joints)))) if len(joints) > 1 else odds
    return holes.where(odds >= 0.0), odds[odds >= 0.0]


def _measure_pockets(deficit: np.ndarray, sections: Sections, holes: Holes) -> Shaped[np.ndarray, " p"]:
    """Return the pockets that holes are, of `scene.bore.POCKET`; none where their rims are open, or few are left."""
    holes, odds = _keep_likely(deficit, sections, holes)
    if len(holes.row) < _MIN_POCKETS:
        return np.empty(0, POCKET)
    grid = sections.grid
    row, column = refine_positions(deficit, sections, holes)
    station, angle = grid.start + (row + 0.5) * grid.step, -np.pi + (column + 0.5) * 2 * np.pi / grid.columns
    slope = slopes(sections, holes)
    length, width = common_size(deficit, sections, holes, slope)
    depth = common_depth(sections, holes, slope)
    radius = float(np.median(sections.radius))
    rim = open_rims(deficit, grid, row, column, (length, width), radius)
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


def _joints_by_steps(
    sections: Sections, holes: Holes, pockets: Shaped[np.ndarray, " p"], pitch: float
) -> Float[np.ndarray, " r"]:
    """Return the ring joints that steps of the wall tell, m; none where they would run through pockets."""
    cells = np.zeros(sections.radius.shape, bool)
    cells[holes.row, holes.column] = True
    columns = sections.grid.columns
    cells = binary_dilation(np.concatenate([cells] * 3, axis=1), np.ones(_RIMS))[:, columns : 2 * columns]
    joints = find_joints_by_steps(sections, cells, pitch)
    if not len(joints):
        return joints
    apart = np.abs(np.mod(pockets["station"] - joints[0] + 0.5 * pitch, pitch) - 0.5 * pitch)
    return joints if np.mean(apart < 0.5 * pockets["length"]) < _THROUGH else np.empty(0)


def _correct_joints(joints: Float[np.ndarray, " r"], by_steps: Float[np.ndarray, " r"]) -> Float[np.ndarray, " r"]:
    """Return the joints by steps where those between pockets are elsewhere in the ring, m."""
    if not len(by_steps):
        return joints
    pitch = float(np.diff(joints).mean())
    apart = np.mod(joints[0] - by_steps[0] + 0.5 * pitch, pitch) - 0.5 * pitch
    return joints if abs(apart) < _SAME_JOINT else by_steps


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
    return sections.spacing == 0.0 and seen > _MIN_SEEN and noise < _NOISE_SHARE * depth


def _deficit(sections: Sections) -> Float[np.ndarray, "rows cols"]:
    """Share of the wall's returns that each cell lacks against those around it: 0 none, 1 all."""
    expected = uniform_filter(sections.support, _EXPECTED, mode=MODES)
    share = sections.support / np.maximum(expected, 1e-9)
    deficit = np.where(expected > _MIN_EXPECTED, np.clip(1 - share, -1, 1), 0.0)
    return np.where(_near_floor(sections), 0.0, deficit)


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
