"""Every return against the model, unexplained ones gathered into places, and the built wall that nobody saw."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import label
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scene.bore import Bore
from scene.cloud import Cloud
from scene.geometry import angle_bins, bin_angles
from scene.writing.track import Track

EXPLAINED, INSIDE, BEHIND, BEYOND = range(4)
_CHUNK = 500_000  # points; bounds the memory
_NEAR = 0.8  # of the tolerance: returns that are radially closer than this are on the wall
_FURTHEST = 0.8  # m from the wall; the distance of returns further off is taken along the radius
_PIECES = 20  # directions to each side in which the nearest piece of wall is looked for


@dataclass(frozen=True)
class TrackZone:
    """The space that a laid track fills: returns in it are the track's, whatever their distance from the floor."""

    half_width: float  # Half the length of a sleeper, m
    top: Float[np.ndarray, " n"]  # Height of the rails' tops above the axis at each station of the bore, m


def track_zone(track: Track, bore: Bore) -> TrackZone | None:
    """Return the space between the ends of the sleepers, up to the rails' tops; `None` without a track."""
    if not track.lines:
        return None
    widest = max(float(np.abs(line.offset).max()) for line in track.lines) + track.config.sleeper_length / 2
    top = np.max([line.seat + line.rail_height for line in track.lines], axis=0)
    return TrackZone(widest, top - bore.position[:, 2])


@dataclass(frozen=True)
class Returns:
    """Returns by their place about the axis of a bore."""

    station: Float[np.ndarray, " p"]  # m; below 0 and above the length beyond the ends
    lateral: Float[np.ndarray, " p"]  # To the left of the axis, m
    upward: Float[np.ndarray, " p"]  # Above the axis, m
    angle: Float[np.ndarray, " p"]  # Direction from the axis, rad
    outward: Float[np.ndarray, " p"]  # Distance behind the wall, m; negative inside
    kind: Int[np.ndarray, " p"]  # `EXPLAINED`, `INSIDE`, `BEHIND` or `BEYOND`
    weight: Float[np.ndarray, " p"]  # Returns that each point stands for

    @property
    def in_span(self) -> Bool[np.ndarray, " p"]:
        """True for returns between the ends of the bore."""
        return self.kind != BEYOND

    def fraction(self, kind: int) -> float:
        """Return the fraction of one kind in all returns, `BEYOND`, or in those between the ends, the others."""
        rows = np.ones(len(self.kind), bool) if kind == BEYOND else self.in_span
        total = float(self.weight[rows].sum())
        return float(self.weight[self.kind == kind].sum()) / total if total else 0.0


def compare_returns(bore: Bore, cloud: Cloud, tolerance: float, track: TrackZone | None = None) -> Returns:
    """Compares every point of a cloud in the bore's frame with the wall, the pockets and the track of a bore.

    Returns are explained up to `tolerance` from the model, m; further than that beyond an end they are `BEYOND`. The
    rows are those of the cloud.
    """
    parts = [
        _compare(bore, cloud.points[k : k + _CHUNK].astype(np.float64), tolerance, track)
        for k in range(0, max(len(cloud.points), 1), _CHUNK)
    ]
    station, lateral, upward, angle, outward, kind = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Returns(station, lateral, upward, angle, outward, kind, cloud.weights.astype(np.float64))


def _compare(bore: Bore, points: np.ndarray, tolerance: float, track: TrackZone | None) -> tuple[np.ndarray, ...]:
    station, lateral, upward = bore.axis.local(points)
    angle = np.arctan2(upward, lateral)
    outward = np.hypot(lateral, upward) - wall_radius(bore, station, angle)
    beyond = (station < -tolerance) | (station > bore.length + tolerance)
    far = np.flatnonzero(~beyond & (np.abs(outward) > _NEAR * tolerance) & (np.abs(outward) < _FURTHEST))
    outward[far] = np.copysign(_distance_to_section(bore, station[far], lateral[far], upward[far]), outward[far])
    kind = np.where(np.abs(outward) <= tolerance, EXPLAINED, np.where(outward > 0, BEHIND, INSIDE))
    kind[kind == BEHIND] = np.where(
        _in_pockets(bore, station, angle, outward, tolerance)[kind == BEHIND], EXPLAINED, BEHIND
    )
    if track is not None:
        row = bore.row_of(station)
        low = (np.abs(lateral) < track.half_width + tolerance) & (upward < track.top[row] + tolerance)
        kind[low & (kind == INSIDE)] = EXPLAINED
    kind[beyond] = BEYOND
    return station, lateral, upward, angle, outward, kind


def wall_radius(bore: Bore, station: np.ndarray, angle: np.ndarray) -> Float[np.ndarray, " p"]:
    """Return the distance from the axis to the wall at places about it, m; the ends hold beyond them."""
    columns = len(bore.angle)
    row = np.clip(station / bore.station[1], 0, len(bore.station) - 1)
    low = np.minimum(row.astype(np.intp), len(bore.station) - 2)
    fraction = row - low
    column = (angle - bore.angle[0]) / (2 * np.pi) * columns % columns
    left = np.floor(column).astype(np.intp) % columns
    right, part = (left + 1) % columns, column - np.floor(column)
    before = (1 - part) * bore.radius[low, left] + part * bore.radius[low, right]
    after = (1 - part) * bore.radius[low + 1, left] + part * bore.radius[low + 1, right]
    return (1 - fraction) * before + fraction * after


def _distance_to_section(
    bore: Bore, station: np.ndarray, lateral: np.ndarray, upward: np.ndarray
) -> Float[np.ndarray, " p"]:
    """Distance to the nearest piece of the section's outline, m: near a corner the radius alone overstates it."""
    columns = len(bore.angle)
    row = bore.row_of(station)
    left = np.floor((np.arctan2(upward, lateral) - bore.angle[0]) / (2 * np.pi) * columns).astype(np.intp)
    least = np.full(len(station), np.inf)
    for step in range(-_PIECES, _PIECES + 1):
        ends = []
        for column in ((left + step) % columns, (left + step + 1) % columns):
            radius = bore.radius[row, column]
            ends.append((radius * np.cos(bore.angle[column]), radius * np.sin(bore.angle[column])))
        (y, z), (y1, z1) = ends
        dy, dz = y1 - y, z1 - z
        along = ((lateral - y) * dy + (upward - z) * dz) / np.maximum(dy**2 + dz**2, 1e-12)
        along = np.clip(along, 0.0, 1.0)
        least = np.minimum(least, np.hypot(lateral - y - along * dy, upward - z - along * dz))
    return least


def _in_pockets(
    bore: Bore, station: np.ndarray, angle: np.ndarray, outward: np.ndarray, tolerance: float
) -> Bool[np.ndarray, " p"]:
    """True for returns in a recess of the lining, or within the tolerance of one."""
    result = np.zeros(len(station), bool)
    pocket = bore.pocket
    rows = np.flatnonzero((outward > tolerance) & (outward < 2.0))
    if not len(pocket) or not len(rows):
        return result
    across = float(np.median(bore.radius))
    place = np.column_stack([pocket["station"], across * pocket["angle"]])
    reach = float(np.hypot(pocket["length"].max(), pocket["width"].max())) / 2 + tolerance
    turn = 2 * np.pi * across
    tree = cKDTree(np.concatenate([place + np.array([0.0, shift]) for shift in (-turn, 0.0, turn)]))
    distance, nearest = tree.query(np.column_stack([station[rows], across * angle[rows]]), distance_upper_bound=reach)
    near = np.isfinite(distance)
    own = pocket[nearest[near] % len(pocket)]
    result[rows[near]] = outward[rows[near]] < own["depth"] + tolerance
    return result


_SIDES = ("floor", "left wall", "crown", "right wall")
_PART = 0.15  # of the weight: a side that holds less goes unnamed


def name_sides(angle: Float[np.ndarray, " k"], weight: Float[np.ndarray, " k"]) -> str:
    """Name the sides of a section in which most of some weights lie, by their directions from left towards up, rad.

    Returns `floor`, `left wall`, `right wall`, `crown`, two of them, or `all around`.
    """
    quarter = np.floor((angle + 3 * np.pi / 4) / (np.pi / 2)).astype(np.intp) % 4
    fraction = np.bincount(quarter, weight, 4) / max(float(weight.sum()), 1e-12)
    named = [_SIDES[k] for k in np.argsort(-fraction, kind="stable") if fraction[k] >= _PART]
    if len(named) == 4:
        return "all around"
    return " and ".join(sorted(named)) if len(named) < 3 else ", ".join(sorted(named))


def name_span(start: float, end: float) -> str:
    """Return `12 m` or `from 12 to 30 m` for an interval of stations, m."""
    first, last = f"{start:.0f}", f"{end:.0f}"
    return f"at {first} m" if first == last else f"from {first} to {last} m"


_CELL = 0.4  # m, edge of the boxes that join returns to a place
_MIN_IN_CELL = 3  # points: a box with fewer holds strays
_MIN_POINTS = 30  # of a place
_WIDEST = 15.0  # m from the axis; what lies further is gathered by station alone
_SLACK = 1.0  # m added to a place at both ends where its fraction of the returns is taken


@dataclass(frozen=True)
class Place:
    """Returns in one place that the model does not explain."""

    start: float  # First station, m
    end: float  # Last station, m
    behind: bool  # Behind the wall; else inside the bore
    sides: str  # Where they lie about the axis, in words
    returns: float  # Number of returns
    fraction: float  # Of the returns at its stations
    furthest: float  # Distance from the wall of all but the last twentieth, m
    low: float  # Height of its lowest part above the floor on the axis, m
    high: float  # Of its highest part, m


def find_places(bore: Bore, returns: Returns) -> tuple[tuple[Place, ...], Bool[np.ndarray, " p"]]:
    """Gathers unexplained returns into places, the largest first.

    Returns the places, and a mask of the unexplained returns that belong to none: strays, `(p,)`.
    """
    places: list[Place] = []
    scattered = np.zeros(len(returns.kind), bool)
    along = np.sort(returns.station[returns.in_span])
    total = np.concatenate([[0.0], np.cumsum(returns.weight[returns.in_span][np.argsort(
        returns.station[returns.in_span], kind="stable")])])  # fmt: skip
    for kind in (INSIDE, BEHIND):
        rows = np.flatnonzero(returns.kind == kind)
        part = _join(returns, rows)
        scattered[rows[part == 0]] = True
        order = np.argsort(part, kind="stable")
        bounds = np.searchsorted(part[order], np.arange(1, part.max(initial=0) + 2))
        for first, last in pairwise(bounds):
            own = rows[order[first:last]]
            if len(own) < _MIN_POINTS:
                scattered[own] = True
                continue
            start, end = np.percentile(returns.station[own], [1, 99])
            near = np.searchsorted(along, [start - _SLACK, end + _SLACK])
            around = float(total[near[1]] - total[near[0]])
            places.append(_describe(bore, returns, own, kind == BEHIND, float(start), float(end), around))
    return tuple(sorted(places, key=lambda place: (-place.returns, place.start))), scattered


def _join(returns: Returns, rows: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    """Number of the place of each return, from 1; 0 for strays."""
    if not len(rows):
        return np.zeros(0, np.intp)
    place = np.stack([returns.station[rows], np.clip(returns.lateral[rows], -_WIDEST, _WIDEST),
                      np.clip(returns.upward[rows], -_WIDEST, _WIDEST)], axis=1)  # fmt: skip
    cell = np.floor((place - place.min(axis=0)) / _CELL).astype(np.intp)
    shape = tuple(int(size) + 1 for size in cell.max(axis=0))
    flat = np.ravel_multi_index(tuple(cell.T), shape)
    full = np.bincount(flat, minlength=int(np.prod(shape))) >= _MIN_IN_CELL
    labels = label(full.reshape(shape), np.ones((3, 3, 3), int))[0]
    return labels.ravel()[flat].astype(np.intp)


def _describe(
    bore: Bore, returns: Returns, own: np.ndarray, behind: bool, start: float, end: float, around: float
) -> Place:
    weight = returns.weight[own]
    floor = -bore.toward(-np.pi / 2)[bore.row_of(returns.station[own])]
    low, high = (float(v) for v in np.percentile(returns.upward[own] - floor, [2, 98]))
    furthest = float(np.percentile(np.abs(returns.outward[own]), 95))
    fraction = float(weight.sum()) / max(around, 1e-9)
    sides = name_sides(returns.angle[own], weight)
    return Place(start, end, behind, sides, float(weight.sum()), fraction, furthest, low, high)


ROW = 1.0  # m
SECTORS = 36  # directions
_SPARSE = 0.03  # of the usual number of returns of a cell: with fewer it was not seen, as stray returns are everywhere
_MIN_AREA = 3.0  # m² of wall in one patch: a smaller one is a shadow that its neighbours tell about
_MIN_LENGTH, _MIN_GIRTH = 1.5, 0.9  # m
_CENTRES = bin_angles(SECTORS)


@dataclass(frozen=True)
class Unseen:
    """One patch of wall without returns."""

    start: float  # First station, m
    end: float  # Last station, m
    area: float  # m²
    sides: str  # Where it lies about the axis, in words
    fraction: float  # Of the girth, in the mean over its stations


@dataclass(frozen=True)
class Coverage:
    """Cells of the built wall, along the bore and around it."""

    start: Float[np.ndarray, " r"]  # First station of each row of cells, m
    end: Float[np.ndarray, " r"]  # Last station, m
    seen: Bool[np.ndarray, "r c"]  # True where enough returns lie on the wall
    patches: tuple[Unseen, ...]  # Unseen patches of some size, the largest first

    @property
    def fraction(self) -> float:
        """Fraction of the cells that were seen."""
        return float(self.seen.mean())


def find_unseen(bore: Bore, returns: Returns) -> Coverage:
    """Finds the parts of a bore's wall on which hardly a return lies."""
    rows = max(round(bore.length / ROW), 1)
    edges = np.linspace(0.0, bore.length, rows + 1)
    on_wall = (returns.kind == EXPLAINED) & (returns.station >= 0) & (returns.station <= bore.length)
    row = np.minimum((returns.station[on_wall] / bore.length * rows).astype(np.intp), rows - 1)
    column = angle_bins(returns.angle[on_wall], SECTORS)
    count = np.bincount(row * SECTORS + column, minlength=rows * SECTORS).reshape(rows, SECTORS)
    area = _cell_areas(bore, edges)
    density = count / area
    usual = float(np.median(density[count > 0])) if (count > 0).any() else 1.0
    seen = density > _SPARSE * usual
    return Coverage(edges[:-1], edges[1:], seen, _list_patches(seen, area, edges))


_BEYOND = 20  # m beyond an end that are looked at
_ON_LINING = 0.25  # m from the wall of the last section, carried on straight
_OVERHEAD = 0.2  # sine of the directions that count: floor and walls go on into a cutting, a crown does not
_GOES_ON = 0.6  # of these directions


def measure_overruns(bore: Bore, returns: Returns) -> tuple[float, float]:
    """Return how far the cloud shows a lining before the first and behind the last station of a bore, at least, m."""
    overhead = (np.sin(returns.angle) > _OVERHEAD) & (np.abs(returns.outward) < _ON_LINING)
    column = angle_bins(returns.angle, SECTORS)
    all_columns = np.sin(_CENTRES) > _OVERHEAD
    result = []
    for beyond in (-returns.station, returns.station - bore.length):
        rows = np.flatnonzero(overhead & (beyond > 0.0) & (beyond < _BEYOND))
        seen = np.zeros((_BEYOND, SECTORS), bool)
        seen[beyond[rows].astype(np.intp), column[rows]] = True
        full = seen[:, all_columns].mean(axis=1) > _GOES_ON
        result.append(max(float(np.argmin(np.append(full, False))) - 1.0, 0.0))  # the last metre may be begun
    return result[0], result[1]


def _cell_areas(bore: Bore, edges: np.ndarray) -> Float[np.ndarray, "r c"]:
    y, z = bore.radius * np.cos(bore.angle), bore.radius * np.sin(bore.angle)
    girth = np.hypot(np.roll(y, -1, axis=1) - y, np.roll(z, -1, axis=1) - z)
    column = angle_bins(bore.angle + 1e-9, SECTORS)
    around = np.stack([girth[:, column == k].sum(axis=1) for k in range(SECTORS)], axis=1)
    middle = (edges[1:] + edges[:-1]) / 2
    return np.maximum(around[bore.row_of(middle)], 1e-3) * np.diff(edges)[:, None]


def _list_patches(seen: np.ndarray, area: np.ndarray, edges: np.ndarray) -> tuple[Unseen, ...]:
    labels, count = label(~seen)
    both = labels[:, [0, -1]][~seen[:, 0] & ~seen[:, -1]].T  # the last column is beside the first
    joins = csr_matrix((np.ones(both.shape[1]), both), shape=(count + 1, count + 1))
    labels = connected_components(joins, directed=False)[1][labels]
    patches = []
    for index in range(1, int(labels.max(initial=0)) + 1):
        row, column = np.nonzero(labels == index)
        if not len(row):
            continue
        size = float(area[row, column].sum())
        start, end = float(edges[row.min()]), float(edges[row.max() + 1])
        if size < _MIN_AREA or end - start < _MIN_LENGTH or size / (end - start) < _MIN_GIRTH:
            continue
        across = float(area[row.min() : row.max() + 1].sum())
        patches.append(Unseen(start, end, size, name_sides(_CENTRES[column], area[row, column]), size / across))
    return tuple(sorted(patches, key=lambda patch: (-patch.area, patch.start)))
