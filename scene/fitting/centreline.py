"""From a cloud to the axis of the bore: through mid-width and mid-height, smooth, with arc length.

The first guess comes from distances *along* the surface, so that no orientation or straightness is assumed. It is then
pulled to the middle of the sections a few times.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import make_lsq_spline
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from scene.bore import Axis, axis_through
from scene.cloud import occupied_cells
from scene.errors import FitError
from scene.fitting.branches import require_no_fold, require_one_bore
from scene.fitting.floorline import fit_floor_line, floor_radius
from scene.fitting.profile import measure_section, section_angles

SKELETON_VOXEL = 0.5
_NEIGHBOURS = (1.2, 1.8, 2.6, 3.8)  # m; profiles may be apart, surveys have gaps
_MIN_JOINED = 0.95
_PART = 0.02  # of the nodes: a smaller part is clutter
_LONGEST_GAP = 12.0  # m
_RIM = 0.5  # m
_SLICE = 1.5
_TILTED = 3


def surface_skeleton(
    points: Float[np.ndarray, "n 3"], min_length: float, origin: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "k 3"]:
    """Return centres of slices across the surface distance, from end to end, m.

    Raises `FitError` for a cloud shorter than `min_length`, m, without two ends, or with a branch or a room. `origin`
    is that of the points' frame in the input's, m, for the message.
    """
    nodes = (occupied_cells(points, SKELETON_VOXEL) + 0.5) * SKELETON_VOXEL
    extent = 2 * float(np.linalg.norm(nodes[:, :2] - nodes[:, :2].mean(axis=0), axis=1).max())
    if extent < min_length:
        raise FitError(f"the tunnel is at most {extent:.1f} m long; at least {min_length:g} m are needed")
    graph, nodes = _surface_graph(nodes)

    def distances(start: int) -> np.ndarray:
        return dijkstra(graph, directed=False, indices=start)

    from_start = distances(int(np.argmax(distances(0))))
    from_end = distances(int(np.argmax(from_start)))
    along = (from_start - from_end) / 2  # the half difference is square to the axis where one distance alone is tilted
    if np.ptp(along) < min_length:
        raise FitError(f"the tunnel is {np.ptp(along):.1f} m long; at least {min_length:g} m are needed")
    own = require_one_bore(nodes, along - along.min(), _SLICE, SKELETON_VOXEL, origin)
    nodes, along = nodes[own], along[own]
    index = np.floor((along - along.min()) / _SLICE).astype(np.intp)
    count = np.bincount(index)
    centres = np.stack([np.bincount(index, nodes[:, axis]) / np.maximum(count, 1) for axis in range(3)], axis=1)
    full = count > 0.4 * np.median(count)
    if full.sum() < 6:
        raise FitError("no tunnel in the cloud: its surface has no two ends")
    # The last slices are tilted: at a mouth the surface distances still fan out from one point.
    trimmed = centres[full]
    return trimmed[_TILTED:-_TILTED] if len(trimmed) >= 4 * _TILTED else trimmed[1:-1]


def _surface_graph(nodes: Float[np.ndarray, "k 3"]) -> tuple[csr_matrix, Float[np.ndarray, "j 3"]]:
    """Joins nodes within a reach that grows until nearly all are connected, then bridges gaps.

    What is still apart from the largest part, further than the longest gap, is left out.
    """
    for reach in _NEIGHBOURS:
        pairs = cKDTree(nodes).query_pairs(reach, output_type="ndarray")
        labels = connected_components(_join_pairs(nodes, pairs), directed=False)[1]
        if np.bincount(labels).max() >= _MIN_JOINED * len(nodes):
            break
    graph = _join_pairs(nodes, np.concatenate([pairs, *_bridges(nodes, labels)]))
    labels = connected_components(graph, directed=False)[1]
    largest = np.flatnonzero(labels == np.bincount(labels).argmax())
    return graph[largest][:, largest], nodes[largest]


def _join_pairs(nodes: np.ndarray, pairs: Int[np.ndarray, "e 2"]) -> csr_matrix:
    lengths = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
    return csr_matrix((lengths, (pairs[:, 0], pairs[:, 1])), shape=(len(nodes), len(nodes)))


def _bridges(nodes: np.ndarray, labels: np.ndarray) -> list[np.ndarray]:
    """Pairs of nodes across each gap between large parts: all nearly as close as the closest, so all around the rim."""
    count = np.bincount(labels)
    parts = [np.flatnonzero(labels == label) for label in np.flatnonzero(count > _PART * len(nodes))]
    result = []
    for k, part in enumerate(parts):
        for other in parts[k + 1 :]:
            distance, nearest = cKDTree(nodes[other]).query(nodes[part], distance_upper_bound=_LONGEST_GAP)
            close = distance < distance.min() + _RIM
            if np.isfinite(distance.min()):
                result.append(np.stack([part[close], other[nearest[close]]], axis=1))
    return result


_HERE = np.zeros(3)
_OVERRUN = 6.0
_FULL_SHARE, _THIN_SHARE = 0.5, 0.05  # of the usual number of points: a full section; one of a bore that is known
_THIN = 20  # points of a thin section
_UNUSUAL = 0.3  # m from the usual section
_SPACING = 1.0
_PASSES = 4
_COARSE_ANGLES = 72
_POINTS_PER_METRE = 5_000
_MIN_SEEN = 0.6
_FURTHEST = 2.0  # times the median radius of a section: further is a passage, which has no part in its middle
_ELONGATION = 1.6
_DOWN, _TRACK = -0.8, 0.5  # directions in which sleepers and rails may hide the bed, and how deep, m


@dataclass(frozen=True)
class CentrelineConfig:
    """Settings of the search for the axis."""

    min_length: float = 10.0  # A cloud shorter than this is refused, m.
    cutoff: float = 12.0  # Wavelength that smoothing halves, m; shorter waviness is the wall's, not the axis'.


def fit_centreline(
    points: Float[np.ndarray, "n 3"], config: CentrelineConfig, origin: Float[np.ndarray, "3"] = _HERE
) -> Axis:
    """Return the axis of the bore, from end to end of a registered cloud, z up, m.

    Raises `FitError` for a cloud that is too short, nothing like a tunnel, or with a branch or a room. `origin` is that
    of the points' frame in the input's, m, so that an error can name the place.
    """
    axis = smooth_axis(surface_skeleton(points, config.min_length, origin), config.cutoff)
    axis = centre_axis(points, axis, config)
    across = 2 * float(np.median(np.hypot(*axis.local(points[:: max(1, len(points) // 20_000)])[1:])))
    if axis.length < _ELONGATION * across:
        raise FitError(f"{axis.length:.0f} m long and {across:.0f} m across: a room, not a tunnel")
    require_no_fold(axis, across, origin)
    return axis


def centre_axis(
    points: Float[np.ndarray, "n 3"],
    axis: Axis,
    config: CentrelineConfig,
    usual: Callable[[Axis], Float[np.ndarray, "k rays"]] | None = None,
) -> Axis:
    """Pulls an axis to the middle of the sections a few times; see `section_middles`.

    Raises `FitError` where it ends up too short.
    """
    stride = max(1, int(len(points) / (axis.length * _POINTS_PER_METRE)))
    sample = points[::stride].astype(np.float64)
    for _ in range(_PASSES):
        axis = smooth_axis(section_middles(sample, axis, usual), config.cutoff)
    if axis.length < config.min_length:
        raise FitError(f"the tunnel is {axis.length:.1f} m long; at least {config.min_length:g} m are needed")
    return axis


def section_middles(
    points: np.ndarray, axis: Axis, usual: Callable[[Axis], Float[np.ndarray, "k rays"]] | None = None
) -> Float[np.ndarray, "k 3"]:
    """Return the middle of each section seen well enough, one a metre.

    `usual` returns the usual radii at stations of an axis. They stand in for directions in which nothing was seen, or
    something 30 cm off: a niche, a lay-by, a flare. Without it, an unseen direction is interpolated from its neighbours
    in the section, and a section that is hardly seen is left out.
    """
    extended = axis.at(np.arange(-_OVERRUN, axis.length + _OVERRUN, _SPACING))
    station, lateral, upward = extended.local(points)
    index = np.rint((station - extended.station[0]) / _SPACING).astype(np.intp)
    angle, radius = np.arctan2(upward, lateral), np.hypot(lateral, upward)
    bins = np.floor((angle + np.pi) / (2 * np.pi) * _COARSE_ANGLES).astype(np.intp) % _COARSE_ANGLES
    centres = section_angles(_COARSE_ANGLES) + np.pi / _COARSE_ANGLES
    order = np.argsort(index, kind="stable")
    bounds = np.searchsorted(index[order], np.arange(len(extended.station) + 1))
    middles, shown = [], []
    count = np.diff(bounds)
    share = _FULL_SHARE if usual is None else _THIN_SHARE  # far from the last tripod a bore is thin, but goes on
    least = max(share * float(np.median(count[count > 0])), 1 if usual is None else _THIN)
    enough = np.flatnonzero(count >= least)
    if usual is not None:
        stand_in = usual(extended)
        if not len(enough):
            raise FitError("no tunnel in the cloud: none of its returns lies on the wall of the way that was followed")
        enough = np.arange(enough[0], enough[-1] + 1)
    for k in enough:
        rows = order[bounds[k] : bounds[k + 1]]
        medians = _bin_medians(bins[rows], radius[rows])
        if usual is not None:
            usual_here = np.abs(medians - stand_in[k]) < _UNUSUAL
            own = float(usual_here.mean())
            medians = np.where(usual_here, medians, stand_in[k])
        seen = np.isfinite(medians)
        if seen.mean() < _MIN_SEEN:
            continue
        shown.append(own if usual is not None else float(seen.mean()))
        around = np.interp(centres, centres[seen], medians[seen], period=2 * np.pi)
        line = fit_floor_line(lateral[rows], upward[rows])
        if line is not None:
            bed = floor_radius(line, centres)
            under_track = (np.sin(centres) < _DOWN) & (bed < around + _TRACK)
            around = np.where(under_track, bed, np.minimum(around, bed))
        around = np.minimum(around, _FURTHEST * np.median(around))
        across, along = measure_section(centres, around).middle
        middles.append(extended.position[k] + across * extended.lateral[k] + along * extended.up[k])
    if len(middles) < 4:
        raise FitError("no tunnel in the cloud: hardly a section shows most of its circumference")
    return np.asarray(middles)[_cut_begun(np.array(shown))]


_BEGUN = 0.8  # of the directions that the next sections show
_NEXT = 3  # sections


def _cut_begun(shown: Float[np.ndarray, " k"]) -> slice:
    """Return the sections without one at either end that is only begun: its middle would bend the axis.

    A mouth cuts it off aslant, and of what lies before a mouth there is no crown. `shown` is the share of each
    section's directions that show its wall.
    """
    if len(shown) < 4 * _NEXT:
        return slice(None)
    first, last = (int(ends[0] < _BEGUN * np.median(ends[1 : _NEXT + 1])) for ends in (shown, shown[::-1]))
    return slice(first, len(shown) - last)


def _bin_medians(bins: np.ndarray, radius: np.ndarray) -> Float[np.ndarray, " m"]:
    order = np.lexsort((radius, bins))
    bounds = np.searchsorted(bins[order], np.arange(_COARSE_ANGLES + 1))
    count = np.diff(bounds)
    if not len(order):
        return np.full(_COARSE_ANGLES, np.nan)
    middle = np.minimum(bounds[:-1] + count // 2, len(order) - 1)
    return np.where(count > 0, radius[order][middle], np.nan)


def smooth_axis(centres: np.ndarray, cutoff: float) -> Axis:
    """Return a least-squares cubic spline by chord length with two knots per `cutoff`.

    A smoothing spline would straighten its ends, by 2 cm on an arc of 150 m; this one has no end condition.
    """
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1))])
    pieces = min(max(round(2 * chord[-1] / cutoff), 1), len(chord) // 4)
    inner = np.linspace(0.0, chord[-1], max(pieces, 1) + 1)[1:-1]
    knots = np.concatenate([[0.0] * 4, inner, [chord[-1]] * 4])
    if len(chord) <= len(inner) + 4:
        return axis_through(centres, _SPACING)
    return axis_through(make_lsq_spline(chord, centres, knots)(chord), _SPACING)
