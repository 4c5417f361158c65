"""The wall of a bore as most of its stations show it, and what lies inside, behind and beyond it.

A wall goes on along the bore; what is short or sparse is something else. For each station and direction the wall is
the outermost distance at which the rows around keep having returns. Over 50 m this gives the usual section, over 8 m
the present one. Where they differ, the present one is a real change if it goes on for a lay-by's length or all around
at once; otherwise something stands in the bore, or opens beside it.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.ndimage import binary_closing, binary_opening, label, uniform_filter1d

from scene.fitting.unroll import Grid, fill_nearest, fill_sides
from scene.geometry import Around, bin_angles

ROW = 0.5  # m
_OVERRUN = 4.0  # m beyond the axis that may still be bore
COLUMNS = 120  # directions
_BIN = 0.1  # m of radius
_USUAL, _PRESENT, _BRIEF = 40.0, 4.0, 1.0  # m before and behind a station
_PERSISTENT = 0.4  # fraction of the rows seen
_MOSTLY = 0.5  # the same for the usual section
_LEAST_ROWS = 3  # that show what persists
_DIFFERENT = 0.3  # m
_LAYBY = 7.0  # m: shorter is a niche
_LONGER = (1 - 2 * _PERSISTENT) * (2 * _PRESENT + ROW)  # m by which what persists is longer than what is there
_WIDEST, _WIDENED = 2.0, 2.6  # times the usual radius: a flare, and what lasts for the length of a lay-by
_AROUND = 0.5  # fraction of the directions that change at once where the section changes
_HIDDEN = 0.3  # fraction of the directions with returns behind: what is in front stands inside
_JUMP = 0.4  # m from one direction to the next


@dataclass(frozen=True)
class Tube:
    """The wall about an axis."""

    grid: Grid  # Stations and directions
    wall: Float[np.ndarray, "rows cols"]  # Distance from the axis, m; nowhere NaN
    usual: Float[np.ndarray, "rows cols"]  # The same as most of 80 m show it, m
    seen: Bool[np.ndarray, "rows cols"]  # A row around showed it
    matched: Bool[np.ndarray, "rows cols"]  # This row itself has returns on it
    closed: Bool[np.ndarray, "rows cols"]  # This row has returns no further than a flare may open
    plane: Bool[np.ndarray, "rows cols"]  # A plane wall, before which things may stand
    behind: Float[np.ndarray, "k 3"]  # Station, lateral and upward offset of places on such walls, m

    def off(self, around: Around) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return how far points are behind the wall of the cells around theirs, and how far inside, m; negative if not.

        Beyond the ends the last row counts.
        """
        cell, radius = self._cell(around), around.radius
        furthest = ndimage.maximum_filter(self.wall, 3, mode=("nearest", "wrap")).ravel()[cell]
        nearest = ndimage.minimum_filter(self.wall, 3, mode=("nearest", "wrap")).ravel()[cell]
        return radius - furthest, nearest - radius

    def before_plane(self, around: Around) -> Bool[np.ndarray, " n"]:
        """Return which points lie in a direction in which things hide a plane wall."""
        return self.plane.ravel()[self._cell(around)]

    def _cell(self, around: Around) -> Int[np.ndarray, " n"]:
        end = self.grid.start + self.grid.rows * self.grid.step
        return self.grid.cell(np.clip(around.station, self.grid.start, end - 1e-6), around.angle)


def measure_tube(
    around: Around, count: Float[np.ndarray, " n"], length: float, reach: Float[np.ndarray, " rays"]
) -> Tube:
    """Return the wall that persists along an axis of some length, m.

    `count` is the number of returns that each point stands for, and `reach` how far the wall is looked for in evenly
    spaced directions, m: what persists further out is the wall of another tunnel.
    """
    grid = Grid.over(-_OVERRUN, length + _OVERRUN, ROW, COLUMNS)
    angle, radius = around.angle, around.radius
    cell = grid.cell(around.station, angle)
    rays = bin_angles(len(reach))
    good = (cell >= 0) & (radius < np.interp(angle, rays, reach, period=2 * np.pi))
    bins = int(np.ceil(reach.max() / _BIN)) + 1
    flat = np.zeros((grid.rows * COLUMNS, bins), bool)
    flat[cell[good], (radius[good] / _BIN).astype(np.intp)] = True
    hit = flat.reshape(grid.rows, COLUMNS, bins)
    hit &= ~_mirrored(grid, cell[good], (radius[good] / _BIN).astype(np.intp), count[good], hit)
    wide = hit.copy()  # a wall wavers by a bin
    wide[..., 1:] |= hit[..., :-1]
    wide[..., :-1] |= hit[..., 1:]
    usual, present, brief = (
        _outermost(wide, hit, window, fraction)
        for window, fraction in ((_USUAL, _MOSTLY), (_PRESENT, _PERSISTENT), (_BRIEF, _PERSISTENT))
    )
    usual = bridge_hanging(fill_nearest(fill_sides(usual, grid.angle)), grid.angle)
    wall = _decide(usual, present, brief, wide)
    row, column, index = np.nonzero(hit)
    on = np.abs((index + 0.5) * _BIN - wall[row, column]) < _DIFFERENT
    matched = np.zeros(wall.shape, bool)
    matched[row[on], column[on]] = True
    nearest = np.where(hit.any(axis=2), hit.argmax(axis=2) * _BIN, np.inf)
    closed = nearest < np.maximum(wall + _DIFFERENT, _WIDEST * usual)
    return Tube(grid, wall, usual, np.isfinite(present), matched, closed, np.zeros(wall.shape, bool), np.empty((0, 3)))


_DOWN = -0.5  # sine of the highest direction in which a floor lies
_BLOCK = 80  # rows
_UNBROKEN, _FAINT = 0.8, 0.4  # fraction of the rows that show a floor; of its density, what lies below it
_BELOW = 5  # bins


def _mirrored(
    grid: Grid, cell: np.ndarray, index: np.ndarray, returns: np.ndarray, hit: np.ndarray
) -> Bool[np.ndarray, "rows cols bins"]:
    """Places below an unbroken floor with far fewer returns than it: water shows there what is above it.

    `hit` are the bins of each cell that hold a point; of each point `cell`, `index` (bin) and `returns` are given.
    """
    result = np.zeros_like(hit)
    bins = hit.shape[2]
    low = np.flatnonzero(np.sin(grid.angle) < _DOWN)
    row, column = np.divmod(cell, grid.columns)
    for first in range(0, grid.rows, _BLOCK):
        here = slice(first, min(first + _BLOCK, grid.rows))
        inside = (row >= here.start) & (row < here.stop)
        count = np.bincount(column[inside] * bins + index[inside], returns[inside], grid.columns * bins)
        density = count.reshape(grid.columns, bins) / (np.arange(bins) + 0.5)  # a direction is wider further out
        density = uniform_filter1d(density, 3, axis=1, mode="constant")
        for k in low:
            floor = int(density[k].argmax())
            rows = hit[here, k]
            shown = rows[:, max(floor - 1, 0) : floor + 2].any(axis=1).sum()
            if shown >= _UNBROKEN * max(rows.any(axis=1).sum(), 1):
                below = floor + _BELOW
                result[here, k, below:] = density[k, below:] < _FAINT * density[k, floor]
    return result


def _outermost(wide: np.ndarray, hit: np.ndarray, window: float, fraction: float) -> Float[np.ndarray, "rows cols"]:
    """Outermost distance with returns in enough of the rows seen within `window` m, m; NaN where there is none."""
    size = 2 * round(window / ROW) + 1
    seen = uniform_filter1d(hit.any(axis=2).astype(np.float32), size, axis=0, mode="constant") * size
    result = np.full(hit.shape[:2], np.nan)
    for column in range(hit.shape[1]):
        rows = uniform_filter1d(wide[:, column].astype(np.float32), size, axis=0, mode="constant") * size
        needed = np.maximum(fraction * seen[:, column], min(_LEAST_ROWS, size / 4) - 0.01)
        enough = (rows >= needed[:, None]) & (rows > 0.5)
        some = enough.any(axis=1)
        last = enough.shape[1] - 1 - enough[:, ::-1].argmax(axis=1)
        # `wide` reaches one bin too far out
        result[some, column] = (last[some] - 0.5) * _BIN
    return result


def _decide(
    usual: np.ndarray, present: np.ndarray, brief: np.ndarray, wide: np.ndarray
) -> Float[np.ndarray, "rows cols"]:
    wall = usual.copy()
    # Wider for a lay-by's length: the bore is wider here.
    wider = (present > usual + _DIFFERENT) & (present < _WIDENED * usual)
    rows = round((_LAYBY + _LONGER) / ROW)
    line = np.ones((rows, 1), bool)
    padded = np.pad(wider, ((rows, rows), (0, 0)), mode="edge")
    lasting = binary_opening(binary_closing(padded, np.ones((5, 1), bool)), line)[rows:-rows]
    lasting &= wider
    wall[lasting] = present[lasting]
    # Wider or narrower all around at once: the section changes, or flares open.
    for found in (present, brief):
        known = np.isfinite(found)
        for changed in ((found > usual + _DIFFERENT) & (found < _WIDEST * usual), found < usual - _DIFFERENT):
            fraction = changed.sum(axis=1) / np.maximum(known.sum(axis=1), 1)
            at_once = (fraction > _AROUND) & (known.mean(axis=1) > _AROUND)
            if found is present:
                at_once &= _nothing_behind(found, changed, wide)
            cells = at_once[:, None] & changed
            wall[cells] = found[cells]
    # Narrower in some directions, without an edge that the wall goes on behind: a platform, a walkway.
    narrower = (present < wall - _DIFFERENT) & np.isfinite(present)
    wall = np.where(_attached(narrower, present, wall), present, wall)
    return wall


def _nothing_behind(found: np.ndarray, changed: np.ndarray, wide: np.ndarray) -> Bool[np.ndarray, " rows"]:
    """Rows in which hardly a changed direction has returns behind what was found."""
    bins = np.arange(wide.shape[2]) * _BIN
    behind = (wide & (bins > np.nan_to_num(found, nan=np.inf)[..., None] + 2 * _DIFFERENT)).any(axis=2)
    return (behind & changed).sum(axis=1) < _HIDDEN * np.maximum(changed.sum(axis=1), 1)


def _attached(narrower: np.ndarray, present: np.ndarray, wall: np.ndarray) -> Bool[np.ndarray, "rows cols"]:
    """Patches of a narrower section that run into the wall on at least one side, and are longer than a lay-by."""
    patches, count = label(np.concatenate([narrower, narrower], axis=1))
    result = np.zeros(narrower.shape, bool)
    columns = narrower.shape[1]
    for k in range(1, count + 1):
        row, column = np.nonzero(patches == k)
        if np.ptp(row) * ROW < _LAYBY or len(np.unique(column)) >= columns:
            continue
        edges = []
        for side in (-1, 1):
            outermost: dict[int, int] = {}
            for r, c in zip(row.tolist(), column.tolist(), strict=True):
                outermost[r] = max(outermost.get(r, side * c), side * c)
            at = np.array([(r, side * c) for r, c in outermost.items()])
            inside = present[at[:, 0], at[:, 1] % columns]
            beyond = wall[at[:, 0], (at[:, 1] + side) % columns]
            edges.append(float(np.median(beyond - inside)))
        if min(edges) < _JUMP:
            result[row, column % columns] = True
    return result & narrower


# Pipes, trays and ducts that hang free under a ceiling all along hide it in some directions, and are no wall: a wall
# goes on to both sides. Where a section comes nearer at once and as suddenly goes back, and what is between lies inside
# the straight line from one edge to the other, it is a thing in the bore, however long it is.
_OVERHEAD = 0.35  # sine of the lowest direction: what stands on the floor or leans on a wall is reported elsewhere
_EDGE = 0.4  # m at both edges
_WITHIN_LINE = 0.3  # m within the line between them
_WIDEST_HANGING = np.deg2rad(60.0)  # rad, of a thing under a ceiling


def bridge_hanging(
    radius: Float[np.ndarray, "rows cols"], angle: Float[np.ndarray, " cols"]
) -> Float[np.ndarray, "rows cols"]:
    """Return sections, m, nowhere NaN, with the straight line of the ceiling in place of what hangs under it.

    Directions grow, rad.
    """
    over = np.flatnonzero(np.sin(angle) > _OVERHEAD)
    result = radius.copy()
    widest = int(_WIDEST_HANGING / (angle[1] - angle[0]))
    step = np.diff(radius[:, over], axis=1)
    nearer, farther = step < -_EDGE, step > _EDGE
    for row in np.flatnonzero(nearer.any(axis=1) & farther.any(axis=1)):
        lefts, rights = np.flatnonzero(nearer[row]), np.flatnonzero(farther[row]) + 1
        result[row, over] = _bridge_section(radius[row, over], angle[over], lefts, rights, widest)
    return result


def _bridge_section(
    section: Float[np.ndarray, " k"], angle: Float[np.ndarray, " k"], lefts: np.ndarray, rights: np.ndarray, widest: int
) -> Float[np.ndarray, " k"]:
    """Return the overhead part of a section, m, with a line over each thing that hangs in it.

    It lies between a place before a jump towards the axis and one after a jump away, at most `widest` places apart.
    """
    section, beyond = section.copy(), 0
    for left in lefts:
        if left < beyond:
            continue  # inside the thing before
        for right in rights[(rights > left + 1) & (rights <= left + 1 + widest)]:
            inside = np.arange(left + 1, right)
            line = _line(section[left], section[right], angle[inside] - angle[left], angle[right] - angle[left])
            if (section[inside] < line - _WITHIN_LINE).all():
                section[inside], beyond = line, int(right)
                break
    return section


def _line(first: float, last: float, turn: Float[np.ndarray, " k"], whole: float) -> Float[np.ndarray, " k"]:
    """Distances to the straight line between two places, by the turn from the first one, rad."""
    return first * last * np.sin(whole) / (first * np.sin(turn) + last * np.sin(whole - turn))


# Plane side walls of a box section, behind whatever stands along them.
# Cabinets, shelves and racks hide most of a wall, and in a sparse cloud they look like one. But above them, or between
# two of them, the wall shows up to the ceiling, and it is the same plane all along. Where nothing shows it lower down,
# what stands there may as well be the wall, and is taken for it. A door set back from the wall does
# not show up to the ceiling, and an alcove not all along.
_FLAT = 0.15  # m that a ceiling or a floor departs from its height, of most directions
_INNER = 0.6  # of the half width: so much of ceiling and floor must be flat
_STRIP = (0.08, 0.50)  # m below the ceiling, where a wall is looked for
_SIDEWAYS = 0.95  # cosine of directions across
_ROW = 1.0  # m of bore
_APART = 0.1  # m between places on a wall
_LAYER, _LEAST, _LEAST_FRACTION = 0.06, 3, 0.04  # m, points, part of a row's: fewer in so thin a layer are strays
_NEXT = 3  # rows: in one of so many the wall shows beside or above things
_ALONG = 15  # rows in whose median a wall stays where it is
_BEFORE, _SOME = 0.3, 0.03  # m before a wall, and fraction of the returns there, that things stand along it
_PROUD = 0.12  # m that things stand before a wall
_LOW = 1.2  # m above the floor: what is lower and has no gap is a walkway, a kerb or a platform, and stays
_FOOT, _GAPS = (0.06, 0.22), 0.08  # m above the floor; fraction of the rows that show the wall there
# m above the floor, and fraction of the height: what shows nowhere between is a void above a ceiling, or a ledge
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
        across = _outermost_layer(side * around.lateral[own], row[own], rows, round(_ROW / tube.grid.step))
        if across is None:
            continue
        distance = across[:, None] / np.maximum(facing, 1e-3)
        upward = distance * np.sin(tube.grid.angle)
        there = (facing > 0) & (upward > floor[:, None]) & (upward < ceiling[:, None])
        hidden = there & (tube.wall * facing < across[:, None] - _PROUD)
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
    fraction = np.linspace(0.0, 1.0, max(int(np.median(high - low) / _APART), 2))
    stations = np.arange(tube.grid.station[0], tube.grid.station[-1], _APART)
    across, low, high = (np.interp(stations, tube.grid.station, rows)[:, None] for rows in (across, low, high))
    places = np.broadcast_arrays(stations[:, None], across, low + fraction * (high - low))
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
    on_wall = np.abs(around.lateral - across[at]) < _PROUD
    low = (row >= 0) & (row < rows) & on_wall & (height > band[0]) & (height < band[1])
    shown = np.bincount(row[low], minlength=rows) > 0
    return uniform_filter1d(shown.astype(float), round(_ALONG * _ROW / step), mode="nearest") > _GAPS


def _outermost_layer(
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
        walls = np.flatnonzero(layer >= max(_LEAST, _LEAST_FRACTION * len(own)))
        if len(walls):
            furthest[k] = np.median(own[walls[-1] + 1 - layer[walls[-1]] : walls[-1] + 1])
    known = np.isfinite(furthest) & (furthest > 0)
    if known.mean() < 0.5:
        return None
    furthest = np.interp(np.arange(count), np.flatnonzero(known), furthest[known])
    even = ndimage.median_filter(ndimage.maximum_filter1d(furthest, _NEXT, mode="nearest"), _ALONG, mode="nearest")
    return np.interp(np.arange(rows), (np.arange(count) + 0.5) * together, even)
