"""Plane side walls of a box section, behind whatever stands along them.

Cabinets, shelves and racks hide most of a wall, and in a sparse cloud they look like one. But above them, or between
two of them, the wall shows up to the ceiling, and it is the same plane all along. Where nothing shows it lower down,
what stands there may as well be the wall, and is taken for it. A door set back from the wall does
not show up to the ceiling, and an alcove not all along.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d

from scene.cleaning.tube import Tube
from scene.geometry import Around

_FLAT = 0.15  # m that a ceiling or a floor departs from its height, of most directions
_INNER = 0.6  # of the half width: so much of ceiling and floor must be flat
_STRIP = (0.08, 0.50)  # m below the ceiling, where a wall is looked for
_SIDEWAYS = 0.95  # cosine of directions across
_ROW = 1.0  # m of bore
_APART = 0.1  # m between places on a wall
_LAYER, _LEAST, _LEAST_SHARE = 0.06, 3, 0.04  # m, points, and share of a row's: fewer in so thin a layer are strays
_NEXT = 3  # rows: in one of so many the wall shows beside or above things
_ALONG = 15  # rows in whose median a wall stays where it is
_BEFORE, _SOME = 0.3, 0.03  # m before a wall, and share of the returns there, that things stand along it
_HIDDEN = 0.12  # m that things stand before a wall
_LOW = 1.2  # m above the floor: what is lower and has no gap is a walkway, a kerb or a platform, and stays
_FOOT, _GAPS = (0.06, 0.22), 0.08  # m above the floor; share of the rows that show the wall there
# m above the floor, and share of the height: what shows nowhere between is a void above a ceiling, or a ledge
_MIDDLE = (0.3, 0.45)
_DEEPEST = 1.6  # m: what lies further behind what is seen in most rows is another room


def find_plane_walls(tube: Tube, around: Around) -> Tube:
    """Return a tube of box section with its side walls where they are plane; any other tube as it was."""
    floor, ceiling = (_level(tube, side) for side in (-1, 1))
    if floor is None or ceiling is None:
        return tube
    rows = tube.grid.rows
    row = np.floor((around.station - tube.grid.start) / tube.grid.step).astype(np.intp)
    below = ceiling[np.clip(row, 0, rows - 1)] - around.upward
    strip = (row >= 0) & (row < rows) & (below > _STRIP[0]) & (below < _STRIP[1])
    plane, wall, usual = np.zeros(tube.wall.shape, bool), tube.wall, tube.usual
    behind = []
    band = (_MIDDLE[0], _MIDDLE[1] * float(np.median(ceiling - floor)))
    for side in (1, -1):
        facing = side * np.cos(tube.grid.angle)
        front = np.median(tube.usual[:, facing > _SIDEWAYS], axis=1)
        own = np.flatnonzero(strip)
        own = own[side * around.lateral[own] < front[row[own]] + _DEEPEST]
        across = _outermost(side * around.lateral[own], row[own], rows, round(_ROW / tube.grid.step))
        if across is None:
            continue
        distance = across[:, None] / np.maximum(facing, 1e-3)
        upward = distance * np.sin(tube.grid.angle)
        there = (facing > 0) & (upward > floor[:, None]) & (upward < ceiling[:, None])
        hidden = there & (tube.wall * facing < across[:, None] - _HIDDEN)
        high = upward > floor[:, None] + _LOW
        gaps = _shows(around, row, side * across, floor, (_FOOT[0], _FOOT[1]), tube.grid.step)
        there &= _shows(around, row, side * across, floor, band, tube.grid.step)[:, None]
        whole = gaps | (hidden & high).any(axis=1)
        there &= high | whole[:, None]
        cell = tube.grid.cell(around.station, around.angle)
        beside = there.ravel()[np.maximum(cell, 0)] & (cell >= 0)
        before = side * around.lateral[beside] < across[row[beside]] - _BEFORE
        if not (there & hidden).any() and before.sum() <= _SOME * before.size:
            continue
        plane |= there
        behind.append(_sample(tube, side * across, np.where(whole, floor, floor + _LOW), ceiling))
        wall, usual = (np.where(there, np.maximum(field, distance), field) for field in (wall, usual))
    return replace(tube, wall=wall, usual=usual, plane=plane, behind=np.concatenate(behind)) if behind else tube


def _sample(tube: Tube, across: np.ndarray, low: np.ndarray, high: np.ndarray) -> Float[np.ndarray, "k 3"]:
    """Return station, lateral and upward offset of places on a plane wall, m."""
    share = np.linspace(0.0, 1.0, max(int(np.median(high - low) / _APART), 2))
    stations = np.arange(tube.grid.station[0], tube.grid.station[-1], _APART)
    across, low, high = (np.interp(stations, tube.grid.station, rows)[:, None] for rows in (across, low, high))
    places = np.broadcast_arrays(stations[:, None], across, low + share * (high - low))
    return np.stack(places, axis=-1).reshape(-1, 3)


def _level(tube: Tube, side: int) -> Float[np.ndarray, " rows"] | None:
    """Return the height of ceiling (1) or floor (-1) above the axis in each row, m; `None` where it is not flat."""
    across, upward = tube.usual * np.cos(tube.grid.angle), tube.usual * np.sin(tube.grid.angle)
    half = np.percentile(np.abs(across), 90, axis=1, keepdims=True)
    inner = (np.abs(across) < _INNER * half) & (side * upward > 0)
    height = np.where(inner, upward, np.nan)
    level = np.nanmedian(height, axis=1)
    off = np.nanpercentile(np.abs(height - level[:, None]), 80, axis=1)
    return level if np.median(off) < _FLAT else None


def _shows(
    around: Around, row: np.ndarray, across: np.ndarray, floor: np.ndarray, band: tuple[float, float], step: float
) -> Bool[np.ndarray, " rows"]:
    """Return the rows about which a wall, `across` of the axis, shows here and there between heights over the floor."""
    rows = len(across)
    at = np.clip(row, 0, rows - 1)
    height = around.upward - floor[at]
    on_wall = np.abs(around.lateral - across[at]) < _HIDDEN
    low = (row >= 0) & (row < rows) & on_wall & (height > band[0]) & (height < band[1])
    shown = np.bincount(row[low], minlength=rows) > 0
    return uniform_filter1d(shown.astype(float), round(_ALONG * _ROW / step), mode="nearest") > _GAPS


def _outermost(
    out: Float[np.ndarray, " p"], row: np.ndarray, rows: int, together: int
) -> Float[np.ndarray, " rows"] | None:
    """Return how far out points lie in rows of a tube, the same for most neighbours, m; `None` where few rows show it.

    `together` rows are looked at as one.
    """
    count = -(-rows // together)
    furthest = np.full(count, np.nan)
    order = np.argsort(row, kind="stable")
    bounds = np.searchsorted(row[order] // together, np.arange(count + 1))
    for k in range(count):
        own = np.sort(out[order[bounds[k] : bounds[k + 1]]])
        layer = np.arange(1, len(own) + 1) - np.searchsorted(own, own - _LAYER)
        walls = np.flatnonzero(layer >= max(_LEAST, _LEAST_SHARE * len(own)))
        if len(walls):
            furthest[k] = np.median(own[walls[-1] + 1 - layer[walls[-1]] : walls[-1] + 1])
    known = np.isfinite(furthest) & (furthest > 0)
    if known.mean() < 0.5:
        return None
    furthest = np.interp(np.arange(count), np.flatnonzero(known), furthest[known])
    even = median_filter(maximum_filter1d(furthest, _NEXT, mode="nearest"), _ALONG, mode="nearest")
    return np.interp(np.arange(rows), (np.arange(count) + 0.5) * together, even)
