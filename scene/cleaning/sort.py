"""Sorts returns by where they lie about a bore: on its wall, inside, behind, beyond its mouths, alone; lists cuts."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scene.cleaning.tube import Tube
from scene.cloud import Cloud
from scene.errors import Cause
from scene.geometry import Around, Axis, angle_bins

_OVERRUN = 60.0  # m beyond the axis that points have stations
_BEHIND = 0.45  # m behind the wall: further is no recess of a lining
_INSIDE = 0.30  # m
_ALONE = 0.15  # m from the wall at which a return without neighbours is a stray
_TRACK = 0.60  # m above the floor: lower is track, kerb or walkway
_FOOT = 1.2  # m: what has a part between these heights stands on the floor
_CELL = 0.25  # m
_ABOVE = 0.08  # m
_END_ENCLOSED = 0.4  # fraction of the directions with wall
_RIM = 1.0  # m
_FEW = 2e-4  # fraction of the points
_USUAL = 0.5  # fraction of the rows that show a direction
_ABOVE_SPRINGING, _MIN_ABOVE = 0.3, 8  # sine of the direction; directions
_ELSEWHERE = 4.0  # times the wall


def look_around(points: Float[np.ndarray, "n 3"], axis: Axis) -> Around:
    """Return points about an axis that runs on straight beyond its ends."""
    return axis.at(np.arange(-_OVERRUN, axis.length + _OVERRUN, 0.25)).local(points)


def end_stations(tube: Tube, around: Around) -> tuple[float, float]:
    """Return the first and last station at which the lining was seen, m.

    Floor and walls may go on into a cutting: the directions above the springing decide, where they were seen at all.
    """
    turn = tube.grid.angle
    usual = tube.closed.mean(axis=0) > _USUAL
    above = usual & (np.sin(turn) > _ABOVE_SPRINGING)
    decide = above if above.sum() >= _MIN_ABOVE else usual
    near = binary_dilation(tube.closed, np.ones((1, 3), bool))[:, decide]
    full = np.flatnonzero(near.mean(axis=1) >= _END_ENCLOSED) if decide.any() else np.empty(0, int)
    first, last = tube.grid.start, tube.grid.start + tube.grid.rows * tube.grid.step
    if not len(full):
        return first, last
    out, _ = tube.off(around)
    column = angle_bins(around.angle, tube.grid.columns)
    on = (out < _BEHIND) & decide[column]

    def outermost(end: float, way: int) -> float:
        """Station up to which 40 % of the directions show the lining; `end` itself where fewer do near it."""
        ahead = way * (around.station - end)
        rows = on & (np.abs(ahead) < 2 * tube.grid.step)
        last_seen = np.full(tube.grid.columns, -np.inf)
        np.maximum.at(last_seen, column[rows], ahead[rows])
        reach = float(np.quantile(last_seen[decide], 1 - _END_ENCLOSED, method="nearest"))
        return end + way * reach if np.isfinite(reach) else end

    first, last = first + full[0] * tube.grid.step, first + (full[-1] + 1) * tube.grid.step
    first, last = outermost(first, -1), outermost(last, 1)
    # Where nothing lies beyond a mouth there is nothing to cut, and its rim stays whole.
    few = _FEW * len(around.station)
    if (around.station < first - _RIM).sum() <= few:
        first -= _RIM
    if (around.station > last + _RIM).sum() <= few:
        last += _RIM
    return first, last


def sort_points(
    around: Around, tube: Tube, supported: Bool[np.ndarray, " n"], ends: tuple[float, float]
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Return how far each point is behind the wall, m, and its `Cause`."""
    out, within = tube.off(around)
    cause = np.full(len(out), Cause.KEPT, np.int8)
    cause[out > _BEHIND] = Cause.BEHIND
    height = _height_above_floor(around, tube)
    inside = (within > _INSIDE) & (height > _TRACK)
    cause[inside] = Cause.INSIDE
    cause[_footprint(around, inside & (height < _TRACK + _FOOT)) & (height > _ABOVE) & (within > _ALONE)] = Cause.INSIDE
    standing = tube.before_plane(around) & (within > _ALONE) & (height > _ABOVE)
    cause[standing] = Cause.STANDING
    cause[~supported & (np.maximum(out, within) > _ALONE)] = Cause.SCATTERED
    beyond = (around.station < ends[0]) | (around.station > ends[1])
    cause[beyond] = Cause.BEYOND
    cause[~beyond & supported & (around.radius > _ELSEWHERE * np.median(tube.wall))] = Cause.ELSEWHERE
    return out, cause


def _height_above_floor(around: Around, tube: Tube) -> Float[np.ndarray, " n"]:
    """Height above the tube's floor under each point, m; infinite over no floor."""
    rows = np.clip(((around.station - tube.grid.start) / tube.grid.step).astype(np.intp), 0, tube.grid.rows - 1)
    turn = tube.grid.angle
    low = np.sin(turn) < -0.3
    y = tube.wall[:, low] * np.cos(turn[low])
    z = tube.wall[:, low] * np.sin(turn[low])
    step = 0.1
    edges = np.arange(y.min(), y.max() + step, step)
    floor = np.stack(
        [np.interp(edges, y[row][np.argsort(y[row])], z[row][np.argsort(y[row])]) for row in range(len(y))]
    )
    column = np.clip(((around.lateral - edges[0]) / step).astype(np.intp), 0, len(edges) - 1)
    return around.upward - floor[rows, column]


def _footprint(around: Around, standing: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Return the points over or under what stands on the floor."""
    if not standing.any():
        return standing
    x, y = (np.floor(v / _CELL).astype(np.int64) for v in (around.station, around.lateral))
    key = x * 100_003 + y
    return np.isin(key, np.unique(key[standing]))


_NEIGHBOURS = 4  # of a point that has support
_SAMPLE = 20_000  # points that tell the usual distance
_FURTHER = 3.0  # times the usual distance to that neighbour
_LEAST = 0.15  # m


def has_support(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Return whether each point has its fourth neighbour within three times the usual distance, at least 15 cm.

    Profiles some way apart are no strays: their points have neighbours in their own profile.
    """
    if len(points) <= _NEIGHBOURS:
        return np.ones(len(points), bool)
    tree = cKDTree(points)
    sample = points[:: max(1, len(points) // _SAMPLE)]
    usual = float(np.median(tree.query(sample, _NEIGHBOURS + 1, workers=-1)[0][:, -1]))
    limit = max(_FURTHER * usual, _LEAST)
    return np.isfinite(tree.query(points, _NEIGHBOURS + 1, distance_upper_bound=limit, workers=-1)[0][:, -1])


_VOXEL = 0.4  # m
_JOINED = 1.0  # m between two voxels of one body
_BODY = 15  # voxels; smaller is clutter
_TOUCHING = 1.5  # m from the wall
_DEEP = 1.5  # m behind the wall: a recess


def name_bodies(
    points: Float[np.ndarray, "n 3"],
    cause: Int[np.ndarray, " n"],
    behind: Float[np.ndarray, " n"],
    supported: Bool[np.ndarray, " n"],
) -> Int[np.ndarray, " n"]:
    """Return the causes, with connected returns off the bore distinguished by depth and distance.

    `behind` is how far each point is behind the wall, m.
    """
    off = np.flatnonzero(np.isin(cause, (Cause.BEHIND, Cause.BEYOND, Cause.ELSEWHERE)) & supported)
    if not len(off):
        return cause
    cells, voxel = np.unique(np.floor(points[off] / _VOXEL).astype(np.int64), axis=0, return_inverse=True)
    voxel = voxel.ravel()
    pairs = cKDTree(cells * _VOXEL).query_pairs(_JOINED, output_type="ndarray")
    links = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    count, body = connected_components(links, directed=False)
    of_point = body[voxel]
    depth, nearest = np.full(count, -np.inf), np.full(count, np.inf)
    np.maximum.at(depth, of_point, behind[off])
    np.minimum.at(nearest, of_point, behind[off])
    beyond = np.bincount(of_point, cause[off] == Cause.BEYOND, count) / np.bincount(of_point, minlength=count)
    voxels = np.bincount(body, minlength=count)
    named = np.full(count, Cause.BEHIND)
    named[(voxels >= _BODY) & (depth > _DEEP) & (nearest < _TOUCHING)] = Cause.BRANCH
    named[(voxels >= _BODY) & (nearest >= _TOUCHING)] = Cause.ELSEWHERE
    named[beyond > 0.5] = Cause.BEYOND
    result = cause.copy()
    stays = (cause[off] == Cause.BEYOND) & (named[of_point] != Cause.ELSEWHERE)
    result[off] = np.where(stays, Cause.BEYOND, named[of_point])
    return result


_ROOT = 20  # percent of a branch's points, those nearest the bore, that are its mouth
_BRANCH = 3.0  # m behind the wall: less is a niche; more a gallery, a room, or the shaft of a manhole
_BUILDING = 2000  # points


@dataclass(frozen=True)
class Removed:
    """One stretch of the cloud that was cut away.

    Stations below 0 or above the bore's length lie beyond its ends.
    """

    start: float  # First station, m
    end: float  # Last station, m
    cause: Cause
    points: int  # Points of the thinned cloud in it
    place: tuple[float, float, float]  # Its middle, of a branch that of its mouth, in the input's frame, m
    nearest: float = 0.0  # How far behind the wall it begins, m
    deepest: float = 0.0  # How far behind the wall it ends, m

    @property
    def facts(self) -> dict[str, Any]:
        """Entries for the manifest."""
        return {**vars(self), "cause": self.cause.words, "code": self.cause.name.lower(), "warning": self.warning}

    @property
    def warning(self) -> str:
        """Sentence for the user; empty where the cut is usual."""
        x, y, z = self.place
        where = f"from station {self.start:.0f} to {self.end:.0f} m, near ({x:.1f}, {y:.1f}, {z:.1f}),"
        if self.cause == Cause.BRANCH and self.deepest > _BRANCH:
            return (
                f"{where} the bore opens into a branch or a room that reaches {self.deepest:.0f} m behind its wall; "
                "it was cut at its mouth: a tunnel there needs a cloud of its own"
            )
        if self.cause == Cause.ELSEWHERE and self.points > _BUILDING:
            return f"{where} another tunnel or building stands {self.nearest:.0f} m behind the wall; it was left out"
        return ""

    def shifted(self, by: float) -> "Removed":
        return replace(self, start=self.start + by, end=self.end + by)

    def reversed(self, length: float) -> "Removed":
        """Return the same stretch by stations that count from the other end of an axis of `length`, m."""
        return replace(self, start=length - self.end, end=length - self.start)


@dataclass(frozen=True)
class Cleaned:
    """The returns of one bore, and what was cut away."""

    cloud: Cloud  # The bore's returns; the same object as the input where nothing was cut
    axis: Axis  # Centreline of the bore, m
    removed: tuple[Removed, ...]  # By station of `axis`, m
    cause: Int[np.ndarray, " n"]  # `Cause` of each point of the uncleaned cloud
    behind: Float[np.ndarray, "k 3"]  # Places on plane walls, where things may hide them, m


def part_of_cloud(cloud: Cloud, rows: Int[np.ndarray, " k"]) -> Cloud:
    """Return some of a cloud's points; the number of returns read stays what it was."""
    intensity = None if cloud.intensity is None else cloud.intensity[rows]
    return replace(cloud, points=cloud.points[rows], weights=cloud.weights[rows], intensity=intensity)


def list_removed(
    cloud: Cloud,
    cause: Int[np.ndarray, " n"],
    station: Float[np.ndarray, " n"],
    gap: float,
    behind: Float[np.ndarray, " n"] | None = None,
) -> tuple[Removed, ...]:
    """List stretches of points with one cause, no two points of a stretch further apart than `gap` along it, m.

    `behind` is how far each point is behind the wall, m; what a user should know of gets a warning by it.
    """
    result = []
    for kind in (kind for kind in Cause if kind is not Cause.KEPT and (cause == kind).any()):
        rows = np.flatnonzero(cause == kind)
        rows = rows[np.argsort(station[rows], kind="stable")]
        for part in np.split(rows, np.flatnonzero(np.diff(station[rows]) > gap) + 1):
            named, depth = part, np.zeros(2)
            if behind is not None:
                depth = np.percentile(behind[part], [1, 99])
                if kind is Cause.BRANCH:  # one goes to its mouth to look, and not to the middle of what was cut
                    named = part[behind[part] <= np.percentile(behind[part], _ROOT)]
            x, y, z = (float(v) for v in np.median(cloud.points[named].astype(np.float64), axis=0) + cloud.origin)
            first, last = (float(station[part[end]]) for end in (0, -1))
            depths = float(depth[0]), float(depth[1])
            result.append(Removed(first, last, kind, len(part), (x, y, z), *depths))
    return tuple(sorted(result, key=lambda part: (part.start, part.cause)))
