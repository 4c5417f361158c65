"""A cloud in, the axis of the bore out: through mid-width and mid-height, smooth, with arc length.

The first guess comes from distances *along* the surface, so that no orientation or straightness is assumed; it is then
pulled to the middle of the sections a few times.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_lsq_spline
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from scene.axis import Axis, through
from scene.errors import FitError
from scene.fitting import floor, profile

_SKELETON_VOXEL = 0.5
_NEIGHBOURS = (1.2, 1.8, 2.6, 3.8)  # m; profiles may be apart, surveys have gaps
_MIN_JOINED = 0.95
_SLICE = 1.5
_TILTED = 3
_OVERRUN = 6.0
_FULL_SHARE = 0.5
_SPACING = 1.0
_PASSES = 4
_COARSE_ANGLES = 72
_POINTS_PER_METRE = 5_000
_MIN_SEEN = 0.6
_ELONGATION = 1.6
_DOWN, _TRACK = -0.8, 0.5  # directions in which sleepers and rails may hide the bed, and how deep, m


@dataclass(frozen=True)
class CentrelineConfig:
    """How the axis is found.

    Attributes:
        min_length: A cloud shorter than this is refused, m.
        cutoff: Wavelength that smoothing halves, m; shorter waviness is the wall's, not the axis'.
    """

    min_length: float = 10.0
    cutoff: float = 12.0


def fit_centreline(points: Float[np.ndarray, "n 3"], config: CentrelineConfig) -> Axis:
    """The axis of the bore, from end to end of the cloud.

    Args:
        points: Registered cloud, z up, m.
        config: See `CentrelineConfig`.

    Raises:
        FitError: Too short, or nothing like a tunnel.
    """
    axis = _smooth(_skeleton(points, config), config.cutoff)
    stride = max(1, int(len(points) / (axis.length * _POINTS_PER_METRE)))
    sample = points[::stride].astype(np.float64)
    for _ in range(_PASSES):
        axis = _smooth(_middles(sample, axis), config.cutoff)
    if axis.length < config.min_length:
        raise FitError(f"the tunnel is {axis.length:.1f} m long; at least {config.min_length:g} m are needed")
    across = 2 * float(np.median(np.hypot(*axis.local(sample[:: max(1, len(sample) // 20_000)])[1:])))
    if axis.length < _ELONGATION * across:
        raise FitError(f"{axis.length:.0f} m long and {across:.0f} m across: a room, not a tunnel")
    return axis


def _skeleton(points: np.ndarray, config: CentrelineConfig) -> Float[np.ndarray, "k 3"]:
    """Centres of slices across the surface distance from end to end."""
    cells = np.unique(np.floor(points / _SKELETON_VOXEL).astype(np.int64), axis=0)
    nodes = (cells + 0.5) * _SKELETON_VOXEL
    graph, nodes = _surface_graph(nodes)

    def distances(start: int) -> np.ndarray:
        return dijkstra(graph, directed=False, indices=start)

    from_start = distances(int(np.argmax(distances(0))))
    from_end = distances(int(np.argmax(from_start)))
    along = (from_start - from_end) / 2  # the half difference is square to the axis where one distance alone is tilted
    if np.ptp(along) < config.min_length:
        raise FitError(f"the tunnel is {np.ptp(along):.1f} m long; at least {config.min_length:g} m are needed")
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
    """Nodes within reach of each other, joined; the reach grows until nearly all hang together."""
    for reach in _NEIGHBOURS:
        pairs = cKDTree(nodes).query_pairs(reach, output_type="ndarray")
        lengths = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
        graph = csr_matrix((lengths, (pairs[:, 0], pairs[:, 1])), shape=(len(nodes), len(nodes)))
        labels = connected_components(graph, directed=False)[1]
        largest = np.flatnonzero(labels == np.bincount(labels).argmax())
        if len(largest) >= _MIN_JOINED * len(nodes):
            break
    return graph[largest][:, largest], nodes[largest]


def _middles(points: np.ndarray, axis: Axis) -> Float[np.ndarray, "k 3"]:
    """Middle of each section seen well enough, one a metre."""
    extended = axis.at(np.arange(-_OVERRUN, axis.length + _OVERRUN, _SPACING))
    station, lateral, upward = extended.local(points)
    index = np.rint((station - extended.station[0]) / _SPACING).astype(np.intp)
    angle, radius = np.arctan2(upward, lateral), np.hypot(lateral, upward)
    bins = np.floor((angle + np.pi) / (2 * np.pi) * _COARSE_ANGLES).astype(np.intp) % _COARSE_ANGLES
    centres = profile.angles(_COARSE_ANGLES) + np.pi / _COARSE_ANGLES
    order = np.argsort(index, kind="stable")
    bounds = np.searchsorted(index[order], np.arange(len(extended.station) + 1))
    middles = []
    full = _FULL_SHARE * np.median(np.diff(bounds)[np.diff(bounds) > 0])
    for k in np.flatnonzero(np.diff(bounds) >= max(full, 1)):
        rows = order[bounds[k] : bounds[k + 1]]
        medians = _medians(bins[rows], radius[rows])
        seen = np.isfinite(medians)
        if seen.mean() < _MIN_SEEN:
            continue
        around = np.interp(centres, centres[seen], medians[seen], period=2 * np.pi)
        line = floor.fit_line(lateral[rows], upward[rows])
        if line is not None:
            bed = floor.radius(line, centres)
            under_track = (np.sin(centres) < _DOWN) & (bed < around + _TRACK)
            around = np.where(under_track, bed, np.minimum(around, bed))
        across, along = profile.measure(centres, around).middle
        middles.append(extended.position[k] + across * extended.lateral[k] + along * extended.up[k])
    if len(middles) < 4:
        raise FitError("no tunnel in the cloud: hardly a section shows most of its circumference")
    return np.asarray(middles)


def _medians(bins: np.ndarray, radius: np.ndarray) -> Float[np.ndarray, " m"]:
    order = np.lexsort((radius, bins))
    bounds = np.searchsorted(bins[order], np.arange(_COARSE_ANGLES + 1))
    count = np.diff(bounds)
    if not len(order):
        return np.full(_COARSE_ANGLES, np.nan)
    middle = np.minimum(bounds[:-1] + count // 2, len(order) - 1)
    return np.where(count > 0, radius[order][middle], np.nan)


def _smooth(centres: np.ndarray, cutoff: float) -> Axis:
    """A least-squares cubic spline by chord length with two knots per `cutoff`.

    A smoothing spline would straighten its ends, by 2 cm on an arc of 150 m; this one has no end condition.
    """
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1))])
    pieces = min(max(round(2 * chord[-1] / cutoff), 1), len(chord) // 4)
    inner = np.linspace(0.0, chord[-1], max(pieces, 1) + 1)[1:-1]
    knots = np.concatenate([[0.0] * 4, inner, [chord[-1]] * 4])
    if len(chord) <= len(inner) + 4:
        return through(centres, _SPACING)
    return through(make_lsq_spline(chord, centres, knots)(chord), _SPACING)
