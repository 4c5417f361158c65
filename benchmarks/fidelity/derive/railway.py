"""Sleepers and rails of the reference: the generator's, or what the held-out recording shows of them."""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.signal import find_peaks

from benchmarks.fidelity.case import Case, of_hold, of_truth
from benchmarks.fidelity.derive.curve import Curve, truth_curve
from benchmarks.fidelity.derive.gauge import gauges
from benchmarks.fidelity.derive.reference_axis import hold_curve

STANDARD_GAUGE = 1.435  # m
_BIN = 0.025  # m of the height profile between the rails
_BETWEEN = 0.55  # m to either side of the track's middle
_WINDOW = 1.2  # m; holds two sleepers, so that its low points are bed and its high points are not
_TOP = 0.20  # m; width of a sleeper
_APART = 0.35  # m; nearer to each other there are no two sleepers
_LEAST_RISE = 0.02  # m; sleepers that stand out less are not told from the bed
_HEAD = (0.12, 0.30)  # m above the bed, where rail heads are
_OFFSETS = np.arange(-0.8, 0.801, 0.02)  # m; of the track from the axis
_HALVES = np.arange(0.50, 0.901, 0.01)  # m; half the distance of two rails
_STEP = 1.0  # m between places of the rails


@dataclass(frozen=True)
class Railway:
    """A track to be matched.

    Attributes:
        curve: In whose coordinates offsets are taken.
        sleeper: Middle of the top of each sleeper, m, `(s, 3)`; empty where none is known.
        rail: Top of both rails, left before right, at the same stations, m, `(2, k, 3)`; `k` is 0 where none is known.
        gauge: m; `None` where it is not measured.
        start: First station of which something is known, m.
        end: Last one, m.
    """

    curve: Curve
    sleeper: Float[np.ndarray, "s 3"]
    rail: Float[np.ndarray, "2 k 3"]
    gauge: float | None
    start: float
    end: float


def railway(case: Case) -> Railway:
    """The true track where there is a truth, else the one that the held-out recording shows."""
    return truth_railway(case) if case.truth is not None else hold_railway(case)


@of_truth
def truth_railway(case: Case) -> Railway:
    """Of the generator; its gauge is measured on its surface."""
    truth = case.truth
    assert truth is not None
    curve = truth_curve(case)
    sleepers, rails = (truth.furniture.get(name) or {} for name in ("sleepers", "rails"))
    sleeper = np.asarray(sleepers.get("position", ())).reshape(-1, 3) - truth.origin
    if not rails:
        return Railway(curve, sleeper, np.zeros((2, 0, 3)), None, 0.0, curve.length)
    rail = np.array([rails["left"], rails["right"]]) - truth.origin
    faces = truth.surface.faces[truth.part == truth.parts.index("rail")]
    mesh = trimesh.Trimesh(truth.surface.vertices, faces, process=False)
    gauge = float(np.mean(gauges(curve, mesh, rail[0], rail[1])))
    return Railway(curve, sleeper, rail, gauge, 0.0, curve.length)


@of_hold
def hold_railway(case: Case) -> Railway:
    """From held-out returns near the floor: sleepers by their periodic height profile, rails by their heads."""
    assert case.hold is not None
    curve = hold_curve(case)
    local = curve.local(case.hold.points)
    inside = (local[:, 0] > curve.station[0]) & (local[:, 0] < curve.station[-1]) & (np.abs(local[:, 1]) < 2.0)
    local = local[inside & (local[:, 2] < 0.0)]
    middle = np.abs(local[:, 1]) < _BETWEEN
    bed = _bed(local[middle], curve)
    low = local[(local[:, 2] - np.interp(local[:, 0], *bed)) < 0.5]
    height = low[:, 2] - np.interp(low[:, 0], *bed)
    offset, half = _heads(low[(height > _HEAD[0]) & (height < _HEAD[1]), 1])
    between = np.abs(low[:, 1] - offset) < _BETWEEN
    station, rise = _sleepers(low[between, 0], height[between])
    top = np.interp(station, *bed) + rise
    sleeper = curve.point(np.column_stack([station, np.full_like(station, offset), top]))
    rail = _rails(low, height, offset, half, curve)
    ends = (float(station[0]), float(station[-1])) if len(station) else (curve.station[0], curve.station[-1])
    return Railway(curve, sleeper, rail, None, *ends)


def _bed(local: Float[np.ndarray, "k 3"], curve: Curve) -> tuple[np.ndarray, np.ndarray]:
    """Stations, and the height of the bed there by the low points of each window, m."""
    station = np.arange(curve.station[0], curve.station[-1], _WINDOW / 2)
    local = local[np.argsort(local[:, 0])]
    edges = np.searchsorted(local[:, 0], [station - _WINDOW / 2, station + _WINDOW / 2])
    level = np.array([np.percentile(local[a:b, 2], 15) if b - a > 20 else np.nan for a, b in edges.T])
    known = np.isfinite(level)
    if known.sum() < 2:
        raise ValueError("too few held-out returns on the floor")
    return station[known], level[known]


def _heads(left: Float[np.ndarray, " k"]) -> tuple[float, float]:
    """Offset of the track and half the distance of its rails: the pair of places where most high points lie, m."""
    count, edges = np.histogram(left, np.arange(-2.0, 2.001, 0.01))
    near = np.convolve(count, np.ones(7), mode="same")  # a head is 7 cm wide
    place = (edges[:-1] + edges[1:]) / 2
    left_head, right_head = (np.interp(_OFFSETS[:, None] + sign * _HALVES, place, near) for sign in (1, -1))
    score = left_head * right_head
    row, column = np.unravel_index(np.argmax(score), score.shape)
    return float(_OFFSETS[row]), float(_HALVES[column])


def _sleepers(station: np.ndarray, height: np.ndarray) -> tuple[Float[np.ndarray, " s"], float]:
    """Stations of the sleepers, and how far they stand out of the bed, m."""
    first = station.min()
    index = ((station - first) / _BIN).astype(int)
    order = np.lexsort((height, index))
    index, height = index[order], height[order]
    bins, start, count = np.unique(index, return_index=True, return_counts=True)
    profile = np.zeros(bins[-1] + 1)
    profile[bins] = height[start + count // 2]  # medians; a bin without a return lies in a sleeper's shadow, low
    rise = float(np.percentile(profile, 75) - np.percentile(profile, 25))
    if rise < _LEAST_RISE:
        return np.empty(0), 0.0
    width = round(_TOP / _BIN)
    smooth = np.convolve(profile, np.ones(width) / width, mode="same")
    peaks, _ = find_peaks(smooth, distance=round(_APART / _BIN), prominence=0.4 * rise)
    high = np.clip(profile, 0.0, 1.3 * rise) > rise / 2
    refined = []
    for peak in peaks:
        near = np.arange(max(peak - width, 0), min(peak + width + 1, len(profile)))
        near = near[high[near]]
        if len(near):
            refined.append(first + (np.median(near) + 0.5) * _BIN)
    tops = profile[high & (profile < 2.0 * rise)]
    return np.asarray(refined), float(np.median(tops))


def _rails(
    local: np.ndarray, height: np.ndarray, offset: float, half: float, curve: Curve
) -> Float[np.ndarray, "2 k 3"]:
    """Middle of the top of both heads, every metre in which both are seen, m."""
    station = np.arange(curve.station[0] + _STEP / 2, curve.station[-1], _STEP)
    found = np.full((2, len(station), 2), np.nan)
    for side, sign in enumerate((1.0, -1.0)):
        head = (np.abs(local[:, 1] - offset - sign * half) < 0.08) & (height > _HEAD[0]) & (height < _HEAD[1])
        points = local[head][np.argsort(local[head, 0])]
        edges = np.searchsorted(points[:, 0], [station - _STEP, station + _STEP])
        for k, (a, b) in enumerate(edges.T):
            if b - a >= 20:
                found[side, k] = _top(points[a:b, 1:])
    seen = np.isfinite(found).all(axis=(0, 2))
    return np.array([curve.point(np.column_stack([station[seen], one[seen]])) for one in found])


def _top(points: Float[np.ndarray, "k 2"]) -> tuple[float, float]:
    """Middle and height of the upper face of a head."""
    upper = points[points[:, 1] > np.percentile(points[:, 1], 90) - 0.03]
    low, high = np.percentile(upper[:, 0], [5, 95])
    core = upper[np.abs(upper[:, 0] - (low + high) / 2) < 0.028]
    return float((low + high) / 2), float(np.median(core[:, 1] if len(core) else upper[:, 1]))
