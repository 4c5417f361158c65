"""Sleepers and rails of reference and candidate."""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.signal import find_peaks
from scipy.spatial import cKDTree
from shapely import Polygon, points

from benchmarks.fidelity.case import Case, per_case, per_hold, per_truth
from benchmarks.fidelity.derive.axis import hold_curve
from benchmarks.fidelity.derive.curve import Curve, candidate_curve, truth_curve
from benchmarks.fidelity.derive.mesh import face_parts
from benchmarks.fidelity.derive.surface import Caster

BELOW_TOP = 0.014  # m; EN 13848 measures there
_GAUGE_STEP = 0.5  # m


def gauge_along(
    curve: Curve, mesh: trimesh.Trimesh, left: Float[np.ndarray, "k 3"], right: Float[np.ndarray, "k 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Measures stations, and the distance between the inner faces of the rails of a mesh there, every half metre, m.

    Either rail is given by points at the height of its top, in any order.
    """
    if min(len(left), len(right)) < 2 or not len(mesh.faces):
        raise ValueError("there are no two rails")
    tops = [sort_along(curve, rail) for rail in (left, right)]
    start, end = max(top[0, 0] for top in tops), min(top[-1, 0] for top in tops)
    station = np.arange(start + 0.13, end - 0.1, _GAUGE_STEP)
    ends = [
        curve.point(np.column_stack([station, *(np.interp(station, top[:, 0], top[:, k]) for k in (1, 2))]))
        for top in tops
    ]
    across = ends[0] - ends[1]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(curve.frames(station)[1], across)
    middle = (ends[0] + ends[1]) / 2 - BELOW_TOP * up
    caster = Caster(mesh)
    reach = caster.first(middle, across)[0] + caster.first(middle, -across)[0]
    met = np.isfinite(reach)
    if not met.any():
        raise ValueError("no ray between the rails meets both")
    return station[met], reach[met]


def sort_along(curve: Curve, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    """Return station, left and up of points, in order of station."""
    local = curve.local(points)
    return local[np.argsort(local[:, 0], kind="stable")]


# Sleepers and rails of the reference: the generator's, or those that the held-out recording shows.

STANDARD_GAUGE = 1.435  # m
_PROFILE_BIN = 0.025  # m of the height profile between the rails
_BETWEEN = 0.55  # m to either side of the track's middle
_BED_WINDOW = 1.2  # m; holds two sleepers, so that its low points are bed and its high points are not
_SLEEPER_WIDTH = 0.20  # m; width of a sleeper
_SLEEPERS_APART = 0.35  # m; nearer to each other there are no two sleepers
_LEAST_RISE = 0.02  # m; sleepers that stand out less count as bed
_HEAD_HEIGHTS = (0.12, 0.30)  # m above the bed, where rail heads are
_OFFSETS = np.arange(-0.8, 0.801, 0.02)  # m; of the track from the axis
_HALVES = np.arange(0.50, 0.901, 0.01)  # m; half the distance of two rails
_RAIL_STEP = 1.0  # m between places of the rails


@dataclass(frozen=True)
class Railway:
    """Track to be matched."""

    curve: Curve  # Curve in whose coordinates offsets are taken
    sleeper: Float[np.ndarray, "s 3"]  # Middle of the top of each sleeper, m; empty where none is known
    # Top of both rails, left before right, at the same stations, m; `k` is 0 where none is known
    rail: Float[np.ndarray, "2 k 3"]
    gauge: float | None  # Gauge, m; `None` where it is not measured
    start: float  # First station of which something is known, m
    end: float  # Last one, m


def reference_railway(case: Case) -> Railway:
    """Return the true track where there is a truth, else the one that the held-out recording shows."""
    return truth_railway(case) if case.truth is not None else hold_railway(case)


@per_truth
def truth_railway(case: Case) -> Railway:
    """Return the generator's track; its gauge is measured on its surface."""
    truth = case.truth
    assert truth is not None
    curve = truth_curve(case)
    sleepers, rails = (truth.furniture.get(name) or {} for name in ("sleepers", "rails"))
    sleeper = np.asarray(sleepers.get("position", ())).reshape(-1, 3) - truth.origin
    if not rails:
        return Railway(curve, sleeper, np.zeros((2, 0, 3)), None, 0.0, curve.length)
    rail = np.array([rails["left"], rails["right"]]) - truth.origin
    gauge = float(np.mean(gauge_along(curve, truth.faces("rail"), rail[0], rail[1])[1]))
    return Railway(curve, sleeper, rail, gauge, 0.0, curve.length)


@per_hold
def hold_railway(case: Case) -> Railway:
    """Finds sleepers by their periodic height profile and rails by their heads, in held-out returns near the floor."""
    assert case.hold is not None
    curve = hold_curve(case)
    local = curve.local(case.hold.points)
    inside = (local[:, 0] > curve.station[0]) & (local[:, 0] < curve.station[-1]) & (np.abs(local[:, 1]) < 2.0)
    local = local[inside & (local[:, 2] < 0.0)]
    middle = np.abs(local[:, 1]) < _BETWEEN
    bed = _bed_heights(local[middle], curve)
    low = local[(local[:, 2] - np.interp(local[:, 0], *bed)) < 0.5]
    height = low[:, 2] - np.interp(low[:, 0], *bed)
    offset, half = _find_heads(low[(height > _HEAD_HEIGHTS[0]) & (height < _HEAD_HEIGHTS[1]), 1])
    between = np.abs(low[:, 1] - offset) < _BETWEEN
    station, rise = _find_sleepers(low[between, 0], height[between])
    top = np.interp(station, *bed) + rise
    sleeper = curve.point(np.column_stack([station, np.full_like(station, offset), top]))
    rail = _find_rails(low, height, offset, half, curve)
    ends = (float(station[0]), float(station[-1])) if len(station) else (curve.station[0], curve.station[-1])
    return Railway(curve, sleeper, rail, None, *ends)


def _bed_heights(local: Float[np.ndarray, "k 3"], curve: Curve) -> tuple[np.ndarray, np.ndarray]:
    """Return stations, and the height of the bed there by the low points of each window, m."""
    station = np.arange(curve.station[0], curve.station[-1], _BED_WINDOW / 2)
    local = local[np.argsort(local[:, 0])]
    edges = np.searchsorted(local[:, 0], [station - _BED_WINDOW / 2, station + _BED_WINDOW / 2])
    level = np.array([np.percentile(local[a:b, 2], 15) if b - a > 20 else np.nan for a, b in edges.T])
    known = np.isfinite(level)
    if known.sum() < 2:
        raise ValueError("too few held-out returns on the floor")
    return station[known], level[known]


def _find_heads(left: Float[np.ndarray, " k"]) -> tuple[float, float]:
    """Return the offset of the track and half the distance of its rails, m: most high points lie there."""
    count, edges = np.histogram(left, np.arange(-2.0, 2.001, 0.01))
    near = np.convolve(count, np.ones(7), mode="same")  # a head is 7 cm wide
    place = (edges[:-1] + edges[1:]) / 2
    left_head, right_head = (np.interp(_OFFSETS[:, None] + sign * _HALVES, place, near) for sign in (1, -1))
    score = left_head * right_head
    row, column = np.unravel_index(np.argmax(score), score.shape)
    return float(_OFFSETS[row]), float(_HALVES[column])


def _find_sleepers(station: np.ndarray, height: np.ndarray) -> tuple[Float[np.ndarray, " s"], float]:
    """Return the stations of the sleepers, and their height over the bed, m."""
    first = station.min()
    index = ((station - first) / _PROFILE_BIN).astype(int)
    order = np.lexsort((height, index))
    index, height = index[order], height[order]
    bins, start, count = np.unique(index, return_index=True, return_counts=True)
    profile = np.zeros(bins[-1] + 1)
    profile[bins] = height[start + count // 2]  # medians; a bin without a return lies in a sleeper's shadow, low
    rise = float(np.percentile(profile, 75) - np.percentile(profile, 25))
    if rise < _LEAST_RISE:
        return np.empty(0), 0.0
    width = round(_SLEEPER_WIDTH / _PROFILE_BIN)
    smooth = np.convolve(profile, np.ones(width) / width, mode="same")
    peaks, _ = find_peaks(smooth, distance=round(_SLEEPERS_APART / _PROFILE_BIN), prominence=0.4 * rise)
    high = np.clip(profile, 0.0, 1.3 * rise) > rise / 2
    refined = []
    for peak in peaks:
        near = np.arange(max(peak - width, 0), min(peak + width + 1, len(profile)))
        near = near[high[near]]
        if len(near):
            refined.append(first + (np.median(near) + 0.5) * _PROFILE_BIN)
    tops = profile[high & (profile < 2.0 * rise)]
    return np.asarray(refined), float(np.median(tops))


def _find_rails(
    local: np.ndarray, height: np.ndarray, offset: float, half: float, curve: Curve
) -> Float[np.ndarray, "2 k 3"]:
    """Return the middle of the top of both heads, every metre in which both are seen, m."""
    station = np.arange(curve.station[0] + _RAIL_STEP / 2, curve.station[-1], _RAIL_STEP)
    tops, high = np.full((2, len(station), 2), np.nan), (height > _HEAD_HEIGHTS[0]) & (height < _HEAD_HEIGHTS[1])
    for side, sign in enumerate((1.0, -1.0)):
        head = high & (np.abs(local[:, 1] - offset - sign * half) < 0.08)
        points = local[head][np.argsort(local[head, 0])]
        edges = np.searchsorted(points[:, 0], [station - _RAIL_STEP, station + _RAIL_STEP])
        for k, (a, b) in enumerate(edges.T):
            if b - a >= 20:
                tops[side, k] = _head_top(points[a:b, 1:])
    known = np.isfinite(tops).all(axis=(0, 2))
    return np.array([curve.point(np.column_stack([station[known], one[known]])) for one in tops])


def _head_top(points: Float[np.ndarray, "k 2"]) -> tuple[float, float]:
    """Return middle and height of the upper face of a head, m."""
    upper = points[points[:, 1] > np.percentile(points[:, 1], 90) - 0.03]
    low, high = np.percentile(upper[:, 0], [5, 95])
    core = upper[np.abs(upper[:, 0] - (low + high) / 2) < 0.028]
    return float((low + high) / 2), float(np.median(core[:, 1] if len(core) else upper[:, 1]))


# The candidate's track in the coordinates of the reference, and within its own bore.

_MISSING_STEP = 1.5  # spacings; a longer step is a missing sleeper, not a spacing
_HALF_SPACING = 0.3  # m; half a spacing


@per_case
def candidate_sleepers(case: Case) -> Float[np.ndarray, "s 3"]:
    """Return the candidate's sleepers in the known stretch of the reference, in its coordinates, by station, m."""
    reference = reference_railway(case)
    local = sort_along(reference.curve, case.candidate.track.sleeper)
    return local[(local[:, 0] > reference.start - _HALF_SPACING) & (local[:, 0] < reference.end + _HALF_SPACING)]


def reference_sleepers(reference: Railway) -> Float[np.ndarray, "s 3"]:
    return sort_along(reference.curve, reference.sleeper)


def sleeper_spacings(sleeper: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, " d"]:
    """Return the distances between neighbours, m; a step over a missing sleeper is left out."""
    step = np.linalg.norm(np.diff(sleeper, axis=0), axis=1)
    return step[step < _MISSING_STEP * np.median(step)] if len(step) else step


@per_case
def candidate_gauge(case: Case) -> Float[np.ndarray, " k"]:
    """Return the gauge along the candidate's exported rails, m."""
    track = case.candidate.track
    return gauge_along(candidate_curve(case), track.rail_mesh, track.rail["left"], track.rail["right"])[1]


@per_case
def rail_offsets(case: Case) -> Float[np.ndarray, "k 3"]:
    """Return stations of the reference's rails, and the candidate track's offset left and above, m."""
    reference, rail = reference_railway(case), case.candidate.track.rail
    if min(len(top) for top in rail.values()) < 2:
        raise ValueError("the candidate has no two rails")
    real = [reference.curve.local(top) for top in reference.rail]
    station = (real[0][:, 0] + real[1][:, 0]) / 2
    judged = []
    for side in ("left", "right"):
        local = sort_along(reference.curve, rail[side])
        known = (station >= local[0, 0]) & (station <= local[-1, 0])
        judged.append([np.where(known, np.interp(station, local[:, 0], local[:, k]), np.nan) for k in (1, 2)])
    gap = np.mean(judged, axis=0).T - (real[0] + real[1])[:, 1:] / 2
    return np.column_stack([station, gap])[np.isfinite(gap).all(axis=1)]


def sleepers_fit(case: Case, margin: float) -> Bool[np.ndarray, " s"]:
    """Return True where the top of each sleeper keeps `margin` (m) from the wall of the local section."""
    bore, track, curve = case.candidate.bore, case.candidate.track, candidate_curve(case)
    corner, at = curve.local(np.asarray(track.sleeper_mesh.vertices)), curve.local(track.sleeper)
    owner = _nearest_row(at[:, 0], corner[:, 0])
    top = corner[:, 2] > at[owner, 2] - margin
    outline = np.stack([bore.radius * np.cos(bore.angle), bore.radius * np.sin(bore.angle)], axis=2)
    rooms = [Polygon(outline[k]).buffer(-margin) for k in _nearest_row(bore.station, at[:, 0])]
    tops = [points(corner[top & (owner == k), 1:]) for k in range(len(rooms))]
    return np.array([len(own) > 0 and bool(room.contains(own).all()) for room, own in zip(rooms, tops, strict=True)])


def _nearest_row(grid: Float[np.ndarray, " n"], values: Float[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    return cKDTree(grid[:, None]).query(values[:, None])[1]


def rail_gaps(case: Case) -> tuple[float, float]:
    """Return the longest gap of the left and the right rail between the first and the last sleeper, m."""
    track, curve = case.candidate.track, candidate_curve(case)
    sleeper, mesh = curve.local(track.sleeper), track.rail_mesh
    start, end = float(sleeper[:, 0].min()), float(sleeper[:, 0].max())
    if not len(mesh.faces):
        return end - start, end - start
    local, part = curve.local(np.asarray(mesh.vertices)), face_parts(mesh)
    corner, owner = mesh.faces.ravel(), np.repeat(part, 3)
    low, high, side = np.full(part.max() + 1, np.inf), np.full(part.max() + 1, -np.inf), np.zeros(part.max() + 1)
    np.minimum.at(low, owner, local[corner, 0])
    np.maximum.at(high, owner, local[corner, 0])
    np.add.at(side, owner, local[corner, 1] - np.median(sleeper[:, 1]))
    left, right = (_longest_gap(low[of], high[of], start, end) for of in (side > 0, side < 0))
    return left, right


def _longest_gap(low: np.ndarray, high: np.ndarray, start: float, end: float) -> float:
    """Return the longest part of start to end that no interval covers."""
    order = np.argsort(low)
    covered = np.maximum.accumulate(np.concatenate([[start], high[order]]))
    return float(max(np.max(np.minimum(np.append(low[order], end), end) - covered), 0.0))


def rail_twist(case: Case, base: float) -> Float[np.ndarray, " k"]:
    """Return the change of the left rail's height above the right one over `base`, every half metre, 1."""
    curve, rail = candidate_curve(case), case.candidate.track.rail
    if min(len(top) for top in rail.values()) < 2:
        return np.empty(0)
    station = np.arange(0.0, curve.length - base, 0.5)
    heights = []
    for side in ("left", "right"):
        along = curve.local(rail[side])[:, 0]
        order = np.argsort(along, kind="stable")
        heights.append([np.interp(at, along[order], rail[side][order, 2]) for at in (station, station + base)])
    before, after = np.array(heights[0]) - np.array(heights[1])
    return (after - before) / base
