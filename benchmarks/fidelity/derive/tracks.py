"""The candidate's track in the coordinates of the reference, and within its own bore."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from shapely import Polygon, points

from benchmarks.fidelity.case import Case, derived
from benchmarks.fidelity.derive import shell
from benchmarks.fidelity.derive.curve import Curve, candidate_curve
from benchmarks.fidelity.derive.gauge import gauges as measured
from benchmarks.fidelity.derive.railway import Railway, railway

_EXTRA = 1.5  # spacings; a longer step is a missing sleeper, not a spacing
_HALF = 0.3  # m; half a spacing


@derived
def in_reach(case: Case) -> Float[np.ndarray, "s 3"]:
    """The candidate's sleepers in the stretch of which the reference knows, in its coordinates, by station, m."""
    reference = railway(case)
    local = _sorted(reference.curve, case.candidate.track.sleeper)
    return local[(local[:, 0] > reference.start - _HALF) & (local[:, 0] < reference.end + _HALF)]


def sleepers(reference: Railway) -> Float[np.ndarray, "s 3"]:
    """The reference's sleepers in its coordinates, by station, m."""
    return _sorted(reference.curve, reference.sleeper)


def spacings(sleeper: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, " d"]:
    """Distances between neighbours, m; a step over a missing sleeper is none."""
    step = np.linalg.norm(np.diff(sleeper, axis=0), axis=1)
    return step[step < _EXTRA * np.median(step)] if len(step) else step


@derived
def gauges(case: Case) -> Float[np.ndarray, " k"]:
    """Gauge along the candidate's exported rails, m."""
    track = case.candidate.track
    return measured(candidate_curve(case), track.rail_mesh, track.rail["left"], track.rail["right"])


@derived
def rail_offsets(case: Case) -> Float[np.ndarray, "k 3"]:
    """At each place of the reference's rails: its station, and how far the candidate's track lies left and above, m.

    Raises:
        ValueError: The candidate has no two rails.
    """
    reference, rail = railway(case), case.candidate.track.rail
    if min(len(top) for top in rail.values()) < 2:
        raise ValueError("the candidate has no two rails")
    real = [reference.curve.local(top) for top in reference.rail]
    station = (real[0][:, 0] + real[1][:, 0]) / 2
    made = []
    for side in ("left", "right"):
        local = _sorted(reference.curve, rail[side])
        known = (station >= local[0, 0]) & (station <= local[-1, 0])
        made.append([np.where(known, np.interp(station, local[:, 0], local[:, k]), np.nan) for k in (1, 2)])
    gap = np.mean(made, axis=0).T - (real[0] + real[1])[:, 1:] / 2
    return np.column_stack([station, gap])[np.isfinite(gap).all(axis=1)]


def _sorted(curve: Curve, place: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    local = curve.local(place)
    return local[np.argsort(local[:, 0], kind="stable")]


def sleepers_fit(case: Case, margin: float) -> Bool[np.ndarray, " s"]:
    """Whether the top of each sleeper keeps `margin` (m) from the wall of the local section."""
    bore, track, curve = case.candidate.bore, case.candidate.track, candidate_curve(case)
    corner, at = curve.local(np.asarray(track.sleeper_mesh.vertices)), curve.local(track.sleeper)
    owner = _nearest(at[:, 0], corner[:, 0])
    top = corner[:, 2] > at[owner, 2] - margin
    outline = np.stack([bore.radius * np.cos(bore.angle), bore.radius * np.sin(bore.angle)], axis=2)
    rooms = [Polygon(outline[k]).buffer(-margin) for k in _nearest(bore.station, at[:, 0])]
    tops = [points(corner[top & (owner == k), 1:]) for k in range(len(rooms))]
    return np.array([len(own) > 0 and bool(room.contains(own).all()) for room, own in zip(rooms, tops, strict=True)])


def _nearest(grid: Float[np.ndarray, " n"], values: Float[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    return cKDTree(grid[:, None]).query(values[:, None])[1]


def rail_gaps(case: Case) -> tuple[float, float]:
    """Longest stretch between the first and the last sleeper that the left and the right rail leave out, m."""
    track, curve = case.candidate.track, candidate_curve(case)
    sleeper, mesh = curve.local(track.sleeper), track.rail_mesh
    start, end = float(sleeper[:, 0].min()), float(sleeper[:, 0].max())
    if not len(mesh.faces):
        return end - start, end - start
    local, part = curve.local(np.asarray(mesh.vertices)), shell.parts(mesh)
    corner, owner = mesh.faces.ravel(), np.repeat(part, 3)
    low, high, side = np.full(part.max() + 1, np.inf), np.full(part.max() + 1, -np.inf), np.zeros(part.max() + 1)
    np.minimum.at(low, owner, local[corner, 0])
    np.maximum.at(high, owner, local[corner, 0])
    np.add.at(side, owner, local[corner, 1] - np.median(sleeper[:, 1]))
    left, right = (_longest_gap(low[of], high[of], start, end) for of in (side > 0, side < 0))
    return left, right


def _longest_gap(low: np.ndarray, high: np.ndarray, start: float, end: float) -> float:
    """Longest part of start to end that no interval covers."""
    order = np.argsort(low)
    covered = np.maximum.accumulate(np.concatenate([[start], high[order]]))
    return float(max(np.max(np.minimum(np.append(low[order], end), end) - covered), 0.0))


def twist(case: Case, base: float) -> Float[np.ndarray, " k"]:
    """Change of the left rail's height above the right one over `base`, every half metre, 1; empty without rails."""
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
