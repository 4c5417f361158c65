"""Held-out beams, the sensor's path, and the same beams cast in the candidate."""

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.signal import savgol_filter
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, kept_until, per_case, per_hold
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.derive.surface import Caster, face_normals, surface_caster

NODE_STEP = 1.0  # m between nodes
_SWAY_WINDOW = 11  # nodes over which the sway of the carrier is smoothed away


@per_hold
def sensor_path(case: Case) -> Curve:
    """Return the smoothed sensor positions of the held-out recording, straight on beyond both ends.

    The positions are strung by nearness, not by time: a way back adds nothing, and poses in a wrong order leave the
    path where it is.
    """
    hold = case.hold
    assert hold is not None
    order = np.argsort(hold.time, kind="stable")
    _, first = np.unique(hold.scan[order], return_index=True)
    nodes: list[np.ndarray] = []
    for position in hold.origin[order[first]]:
        if not nodes or np.linalg.norm(np.asarray(nodes) - position, axis=1).min() >= 0.9 * NODE_STEP:
            nodes.append(position)
    if len(nodes) < 4:
        raise ValueError(f"the held-out sensor passed {len(nodes)} positions {NODE_STEP} m apart; 4 are needed")
    strung = _string_nodes(np.asarray(nodes))
    window = min(_SWAY_WINDOW, len(nodes) - (len(nodes) + 1) % 2)
    return Curve.through(savgol_filter(strung, window, min(2, window - 1), axis=0, mode="interp"))


def _string_nodes(nodes: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Orders positions from the end nearer to the first of them, always on to the nearest one left."""
    far = nodes[np.argmax(np.linalg.norm(nodes - nodes.mean(axis=0), axis=1))]
    other = nodes[np.argmax(np.linalg.norm(nodes - far, axis=1))]
    here = min((far, other), key=lambda end: float(np.linalg.norm(end - nodes[0])))
    left, order = np.ones(len(nodes), bool), []
    for _ in nodes:
        order.append(int(np.argmin(np.where(left, np.sum((nodes - here) ** 2, axis=1), np.inf))))
        left[order[-1]] = False
        here = nodes[order[-1]]
    return nodes[order]


def mouths_on_path(case: Case) -> tuple[float, float]:
    """Return the stations of the candidate's two ends on the sensor's path, m, the smaller one first."""
    ends = sensor_path(case).local(case.candidate.bore.position[[0, -1]])[:, 0]
    return float(ends.min()), float(ends.max())


# Held-out beams, and the same beams cast in the candidate.

_NEAR = 1.0  # m over which the path's frame is taken as straight: less than a millimetre at a radius of 500 m


@dataclass(frozen=True)
class Returns:
    """Held-out beams that came back, in the order of time."""

    scan: Int[np.ndarray, " n"]  # Number of the scan
    origin: Float[np.ndarray, "n 3"]  # Position of the sensor, m
    direction: Float[np.ndarray, "n 3"]  # Unit vectors
    range: Float[np.ndarray, " n"]  # Measured range, m
    points: Float[np.ndarray, "n 3"]  # Points of the returns, m
    local: Float[np.ndarray, "n 3"]  # Station, left and up of the points along `sensor_path`, m
    heading: Float[np.ndarray, "n 3"]  # `direction` in the path's frame at the points


@dataclass(frozen=True)
class CastBeams:
    """The beams of `Returns`, cast in the candidate."""

    range: Float[np.ndarray, " n"]  # Range in the candidate, m; `inf` where the beam leaves it
    face: Int[np.ndarray, " n"]  # Face of `visible_surface`; -1 where nothing is hit
    cosine: Float[np.ndarray, " n"]  # Cosine between beam and face normal, 0 to 1, 0 where nothing is hit
    difference: Float[np.ndarray, " n"]  # Range in the candidate less range measured, m

    @property
    def hit(self) -> Bool[np.ndarray, " n"]:
        return self.face >= 0


@per_hold
def returns(case: Case) -> Returns:
    """Return the held-out returns, sorted so that the order in the file does not matter."""
    hold = case.hold
    assert hold is not None
    order = np.lexsort((hold.direction[:, 2], hold.time))
    order = order[hold.returned[order]]
    direction, path = hold.direction[order], sensor_path(case)
    points = hold.origin[order] + hold.range[order, None] * direction
    local = path.local(points)
    axes = path.frames(local[:, 0])[1:]
    heading = np.stack([np.einsum("ij,ij->i", direction, axis) for axis in axes], axis=1)
    return Returns(hold.scan[order], hold.origin[order], direction, hold.range[order], points, local, heading)


@kept_until("LIN", per_case)
def cast_beams(case: Case) -> CastBeams:
    """Casts every held-out beam with a return in everything visible of the candidate."""
    real, rays = returns(case), surface_caster(case)
    reach, face = rays.first(real.origin, real.direction)
    cosine, hit = np.zeros(len(face)), face >= 0
    cosine[hit] = _incidence_cosines(rays, face[hit], real.direction[hit])
    return CastBeams(reach, face, np.minimum(cosine, 1.0), reach - real.range)


def _incidence_cosines(
    rays: Caster, face: Int[np.ndarray, " n"], direction: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    normal = face_normals(rays.mesh, face)
    return np.abs(np.einsum("ij,ij->i", normal, direction)) / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)


def points_at(case: Case, reach: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Return the points on the held-out beams at other ranges, m; NaN where the range is not finite."""
    real = returns(case)
    return real.origin + np.where(np.isfinite(reach), reach, np.nan)[:, None] * real.direction


def local_at(case: Case, reach: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Return these points in station, left and up along the sensor's path, m."""
    real = returns(case)
    shift = np.where(np.isfinite(reach), reach, np.nan) - real.range
    local = real.local + shift[:, None] * real.heading
    far = np.abs(shift) > _NEAR
    local[far] = sensor_path(case).local(real.points[far] + shift[far, None] * real.direction[far])
    return local


@kept_until("OCC", per_case)
def noisy_ranges(case: Case, draw: str) -> Float[np.ndarray, " n"]:
    """Return the ranges that the sensor would have measured in the candidate, m; `inf` where a beam leaves it.

    The same name of a draw gives the same noise.
    """
    assert case.hold is not None
    noise = case.rng(f"range noise {draw}").standard_normal(len(cast_beams(case).range))
    return cast_beams(case).range + case.hold.sigma * noise


@per_case
def synthetic_points(case: Case) -> Float[np.ndarray, "n 3"]:
    """Return the noisy points of the cast beams, m, `(n, 3)`; NaN where a beam leaves the candidate."""
    return points_at(case, noisy_ranges(case, "first"))


def side_points(case: Case, real: bool) -> Float[np.ndarray, "n 3"]:
    return returns(case).points if real else synthetic_points(case)


# Bins along the observed stretch of the path.

BIN = 10.0  # m


@per_hold
def observed_extent(case: Case) -> tuple[float, float]:
    """Return the stations between which the held-out returns lie, but for one in a thousand at either end, m."""
    low, high = np.percentile(returns(case).local[:, 0], [0.1, 99.9])
    return float(low), float(high)


def station_bins(case: Case, station: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Return equal bins of about `BIN` over `observed_extent`; first and last hold the stations beyond."""
    low, high = observed_extent(case)
    count = max(round((high - low) / BIN), 1)
    return np.clip(((station - low) / (high - low) * count).astype(int), 0, count - 1)


@per_case
def silence(case: Case) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return True for each beam without a return, as measured and as expected in the candidate.

    A beam is expected back if it meets the candidate within the sensor's reach and its echo, cos(incidence) over the
    squared distance, is not too weak. No data sheet says how weak: the cut is the one number that the recording sets,
    where beams with a weaker echo in the candidate were more often silent than not.
    """
    hold = case.hold
    assert hold is not None
    rays = surface_caster(case)
    reach, face = rays.first(hold.origin, hold.direction)
    met = np.flatnonzero((face >= 0) & (reach <= hold.range_max))
    cosine = _incidence_cosines(rays, face[met], hold.direction[met])
    order = np.argsort(cosine / np.maximum(reach[met], 0.1) ** 2, kind="stable")
    balance = np.concatenate([[0], np.cumsum(np.where(hold.returned[met[order]], -1, 1))])
    expected_silent = np.ones(len(reach), bool)
    expected_silent[met[order[int(np.argmax(balance)) :]]] = False
    return ~hold.returned, expected_silent


# Directions of the beams, and descriptors of whole scans.

_DIRECTION_SECTORS = (12, 4)  # of azimuth and elevation
_QUANTILES = (5, 25, 50, 75, 95)


@per_hold
def beam_directions(case: Case) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return azimuth to the left, and elevation, of every returned beam from the tunnel's axis at the sensor, rad."""
    real, path = returns(case), sensor_path(case)
    _, starts = np.unique(real.scan, return_index=True)
    tangent, left, up = path.frames(path.local(real.origin[starts])[:, 0])[1:]
    number = np.searchsorted(real.scan[starts], real.scan)
    ahead, aside, above = (np.einsum("ij,ij->i", axis[number], real.direction) for axis in (tangent, left, up))
    return np.arctan2(aside, ahead), np.arcsin(np.clip(above, -1.0, 1.0))


@per_case
def scan_descriptors(case: Case) -> tuple[Float[np.ndarray, "s d"], Float[np.ndarray, "s d"], Int[np.ndarray, " s"]]:
    """Return the descriptors of the scans, real and synthetic, and the number of each scan.

    A descriptor holds quantiles of the ranges and their median in sectors of azimuth and elevation, in log metres; a
    sector without beams in either holds the scan's median.
    """
    real, reach = returns(case), noisy_ranges(case, "first")
    both, sector = np.isfinite(reach), np.zeros(len(reach), int)
    for angle, count in zip(beam_directions(case), _DIRECTION_SECTORS, strict=True):
        edges = np.quantile(angle, np.linspace(0.0, 1.0, count + 1)[1:-1])
        sector = sector * count + np.searchsorted(edges, angle)
    rows: list[tuple[np.ndarray, np.ndarray]] = []
    numbers = np.unique(real.scan)
    bounds = np.searchsorted(real.scan, np.append(numbers, numbers[-1] + 1))
    for start, end in itertools.pairwise(bounds):
        kept = np.flatnonzero(both[start:end]) + start
        if len(kept) > np.prod(_DIRECTION_SECTORS):
            one, other = (_describe_scan(np.maximum(r[kept], 0.01), sector[kept]) for r in (real.range, reach))
            rows.append((one, other))
    if len(rows) < 10:
        raise ValueError(f"{len(rows)} scans with returns from the candidate are too few to tell apart")
    left, right = zip(*rows, strict=True)
    return np.asarray(left), np.asarray(right), np.arange(len(rows))


def _describe_scan(reach: Float[np.ndarray, " n"], sector: Int[np.ndarray, " n"]) -> Float[np.ndarray, " d"]:
    log = np.log(reach)
    quantiles = np.percentile(log, _QUANTILES)
    parts = np.full(int(np.prod(_DIRECTION_SECTORS)), quantiles[len(quantiles) // 2])
    order = np.argsort(sector, kind="stable")
    groups, starts = np.unique(sector[order], return_index=True)
    parts[groups] = [np.median(group) for group in np.split(log[order], starts[1:])]
    return np.concatenate([quantiles, parts])


@kept_until("DEG", per_hold)
def cloud_tree(case: Case) -> cKDTree:
    return cKDTree(returns(case).points, balanced_tree=False)
