"""Distances in the air: to the surface around the axis, up and down in lanes, and what of vehicle envelopes is free."""

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, derived, of_hold, of_truth, until
from benchmarks.fidelity.derive import profiles
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.derive.freeplane import truth_caster
from benchmarks.fidelity.derive.reference_axis import hold_local, hold_points, reference_curve
from benchmarks.fidelity.derive.sections import sections
from benchmarks.fidelity.derive.surface import Nearest, intersector, nearest

LANES = (-1.0, 0.0, 1.0)  # m to the left of the axis
_AROUND = 1.0  # m to either side of the axis, and up and down
_NODE = 0.25  # m between the places in a section
_LANE_HALF = 0.15  # m
_LANE_BIN = 0.5  # m of chainage
_VEHICLE = (2.8, 3.8)  # m; a metro car (type B), width and height above the rails
_ABOVE_FLOOR = 0.45  # m; where its envelope begins
_TIGHTER = (0.0, 0.05, 0.10)  # m that the reference's own median outline is drawn in


@dataclass(frozen=True)
class Clearances:
    """Distance to the nearest surface around the axis.

    Attributes:
        station: Of the sections, m, `(n,)`.
        judged, reference: By section and place in it, m, `(n, k)`.
    """

    station: Float[np.ndarray, " n"]
    judged: Float[np.ndarray, "n k"]
    reference: Float[np.ndarray, "n k"]


def _places(case: Case) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "k 3"]]:
    station = sections(case).station
    offset = np.arange(-_AROUND, _AROUND + 1e-9, _NODE)
    grid = np.stack(np.meshgrid(station, offset, offset, indexing="ij"), axis=-1)
    return station, reference_curve(case).point(grid.reshape(-1, 3))


@until("F3D")
@of_truth
def _truth_nearest(case: Case) -> Nearest:
    assert case.truth is not None
    return Nearest(case.truth.surface)


@derived
def clearances(case: Case) -> Clearances:
    """Of candidate and reference; a held-out recording's is the distance to its nearest return."""
    station, points = _places(case)
    judged = nearest(case).query(points)[0]
    if case.truth is not None:
        reference = _truth_nearest(case).query(points)[0]
    else:
        reference = cKDTree(hold_points(case)).query(points)[0]
    shape = (len(station), -1)
    return Clearances(station, judged.reshape(shape), reference.reshape(shape))


@derived
def headrooms(case: Case) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Stations, and floor to crown in three lanes of candidate and reference, m; NaN where not known.

    Medians over 0.5 m of chainage, so that a sleeper a centimetre off counts by its centimetre.
    """
    curve = reference_curve(case)
    station = np.arange(curve.station[0] + _LANE_BIN, curve.station[-1] - _LANE_BIN, _LANE_BIN)
    judged = _cast_headroom(intersector(case).first, curve, station)
    if case.truth is not None:
        return station, judged, _cast_headroom(truth_caster(case).first, curve, station)
    return station, judged, _seen_headroom(case)(station)


def _cast_headroom(first, curve: Curve, station: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    fine = (station[:, None] + np.linspace(-0.4, 0.4, 5) * _LANE_BIN).ravel()
    position, _, left, up = curve.frames(fine)
    lanes = []
    for lane in LANES:
        eye = position + lane * left
        total = first(eye, up)[0] + first(eye, -up)[0]
        lanes.append(profiles.nanmedian(np.where(np.isfinite(total), total, np.nan).reshape(len(station), -1)))
    return np.column_stack(lanes)


@of_hold
def _seen_headroom(case: Case):
    local = hold_local(case)

    def at(station: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        row = np.floor((local[:, 0] - station[0]) / _LANE_BIN + 0.5).astype(int)
        lanes = []
        for lane in LANES:
            near = (np.abs(local[:, 1] - lane) < _LANE_HALF) & (row >= 0) & (row < len(station))
            ends = [near & (sign * local[:, 2] > 1.0) for sign in (1, -1)]
            top, bottom = (profiles.grouped_median(row[kept], local[kept, 2], len(station), 5) for kept in ends)
            lanes.append(top - bottom)
        return np.column_stack(lanes)

    return at


@derived
def infringed(case: Case) -> tuple[Bool[np.ndarray, "n e"], Bool[np.ndarray, "n e"]]:
    """Whether lining and reference cut into each of four envelopes in every section.

    A metro car's envelope, and the median outline of the reference drawn in by 0, 5 and 10 cm: a car alone is clear of
    any bore that it is driven through and would tell nothing apart.
    """
    cut = sections(case)
    typical = profiles.nanmedian(cut.reference.T)
    known = np.isfinite(typical)
    ring = (typical[:, None] * np.column_stack([np.cos(cut.angle), np.sin(cut.angle)]))[known]
    outline = shapely.make_valid(shapely.Polygon(ring))
    floor = shapely.bounds(outline)[1] + _ABOVE_FLOOR
    car = shapely.box(-_VEHICLE[0] / 2, floor, _VEHICLE[0] / 2, floor + _VEHICLE[1])
    envelopes = [car, *(outline.buffer(-inset) for inset in _TIGHTER)]
    both = []
    for sides in (cut.judged_outline, cut.reference_outline):
        lost = [shapely.area(shapely.difference(envelope, sides)) > 0.005 * envelope.area for envelope in envelopes]
        both.append(np.column_stack(lost))
    return both[0], both[1]
