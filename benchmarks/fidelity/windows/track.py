"""Furniture by station: gauge, place and height of the rails, bed with sleepers, depth of the pockets."""

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.fidelity.case import Case, per_case, per_truth
from benchmarks.fidelity.derive.beams import cast_beams, returns, sensor_path
from benchmarks.fidelity.derive.curve import Curve, grouped_median, nanmedian, truth_curve
from benchmarks.fidelity.derive.sections import truth_caster
from benchmarks.fidelity.derive.surface import face_normals, surface_caster
from benchmarks.fidelity.derive.track import gauge_along, sort_along, truth_railway
from benchmarks.fidelity.registry import Samples
from benchmarks.fidelity.windows.deviation import (
    COLUMNS,
    FINE,
    Relief,
    beam_offsets,
    hold_frame,
    parts_hit,
    relief_on_truth,
    truth_relief,
)

BED_BIN = 0.05  # m along the track
_BETWEEN = (0.15, 0.55)  # m to either side of the track's middle: bed and sleepers, clear of rails and their shadow
_UPRIGHT = 0.8  # of a normal that counts as level or as upright
_LEAST = 4  # returns that make a bin of the bed known
_LANES = (-0.45, -0.25, 0.25, 0.45)  # m from the track's middle where the true bed is sounded
_SOUND_FROM = 0.5  # m above the rails
_RIM = 0.08  # m from the edge of a pocket to where the wall beside it is measured


NOTHING = Samples(np.empty(0), np.empty(0))


def has_rails(case: Case) -> bool:
    return bool(min(len(top) for top in case.candidate.track.rail.values()) >= 2)


def _rails_on(case: Case, curve: Curve) -> dict[str, Float[np.ndarray, "k 3"]]:
    return {side: sort_along(curve, points) for side, points in case.candidate.track.rail.items()}


# By the truth.


@per_truth
def _true_gauge(case: Case) -> tuple[np.ndarray, np.ndarray]:
    rail = truth_railway(case).rail
    assert case.truth is not None
    return gauge_along(truth_curve(case), case.truth.faces("rail"), rail[0], rail[1])


@per_case
def true_gauge_error(case: Case) -> Samples:
    """Return the gauge of the candidate less the true one, every half metre, m."""
    if not truth_railway(case).rail.shape[1] or not has_rails(case):
        return NOTHING
    track = case.candidate.track
    real = _true_gauge(case)
    station, gauge = gauge_along(truth_curve(case), track.rail_mesh, track.rail["left"], track.rail["right"])
    return Samples(gauge - np.interp(station, *real), station)


@per_case
def true_rail_offsets(case: Case) -> tuple[Samples, Samples]:
    """Return the lateral offset of the track's middle, and the height of each rail over its true one, m."""
    real = truth_railway(case)
    if not real.rail.shape[1] or not has_rails(case):
        return NOTHING, NOTHING
    judged, offsets = _rails_on(case, real.curve), []
    for side, top in zip(("left", "right"), real.rail, strict=True):
        local, mine = sort_along(real.curve, top), judged[side]
        inside = (local[:, 0] >= mine[0, 0]) & (local[:, 0] <= mine[-1, 0])
        at = np.column_stack([np.interp(local[:, 0], mine[:, 0], mine[:, k]) for k in (1, 2)])
        offsets.append(np.column_stack([local[:, 0], np.where(inside[:, None], at - local[:, 1:], np.nan)]))
    left, right = offsets
    known = np.isfinite(left[:, 1]) & np.isfinite(right[:, 1])
    aside = Samples((left[known, 1] + right[known, 1]) / 2.0, left[known, 0])
    height = np.concatenate([left[known], right[known]])
    return aside, Samples(height[:, 2], height[:, 0])


def true_bed_error(case: Case) -> Samples:
    """Return the height of the candidate's bed and sleepers less the true one between the rails, every 5 cm, m."""
    real = truth_railway(case)
    if not real.rail.shape[1]:
        return NOTHING
    curve = real.curve
    tops = [sort_along(curve, top) for top in real.rail]
    station = np.arange(0.5, curve.length - 0.5, BED_BIN)
    middle, top = (np.mean([np.interp(station, one[:, 0], one[:, k]) for one in tops], axis=0) for k in (1, 2))
    places = [np.column_stack([station, middle + lane, top + _SOUND_FROM]) for lane in _LANES]
    origin = curve.point(np.concatenate(places))
    down = -np.tile(curve.frames(station)[3], (len(_LANES), 1))
    depth = [caster.first(origin, down)[0] for caster in (truth_caster(case), surface_caster(case))]
    gap = np.clip(np.where(np.isfinite(depth[1]), depth[0] - depth[1], -1.0), -0.3, 0.3)
    return Samples(np.where(np.isfinite(depth[0]), gap, 0.0), np.tile(station, len(_LANES)))


def true_pocket_error(case: Case) -> Samples:
    """Return by how much each open pocket of the truth is deeper or flatter in the candidate, m."""
    truth = case.truth
    assert truth is not None
    pockets = [one for one in truth.furniture.get("pockets", []) if one.get("open", True)]
    if not pockets:
        return NOTHING
    station, angle, length = (np.array([one[key] for one in pockets]) for key in ("station", "angle", "length"))
    depths = [_depth_at(relief, station, angle, length) for relief in (truth_relief(case), relief_on_truth(case))]
    known = np.isfinite(depths[0]) & np.isfinite(depths[1])
    return Samples((depths[1] - depths[0])[known], station[known])


def _depth_at(
    relief: Relief, station: Float[np.ndarray, " p"], angle: Float[np.ndarray, " p"], length: Float[np.ndarray, " p"]
) -> Float[np.ndarray, " p"]:
    """Return how much farther a surface is in the middle of each pocket than before and behind it, m."""
    row = np.round((station - relief.station[0]) / FINE).astype(int)
    column = np.floor((angle + np.pi) / (2.0 * np.pi) * COLUMNS).astype(int)
    beyond = np.ceil((0.5 * length + _RIM) / FINE).astype(int)
    inside = (row - beyond - 1 >= 0) & (row + beyond + 1 < len(relief.station))
    row = np.clip(row, 0, len(relief.station) - 1)

    def patch(rows: np.ndarray) -> np.ndarray:
        near = [
            relief.radius[np.clip(rows + i, 0, len(relief.station) - 1), (column + j) % COLUMNS]
            for i in (-1, 0, 1) for j in (-1, 0, 1)
        ]  # fmt: skip
        return nanmedian(np.stack(near, axis=-1))

    around = (patch(row - beyond) + patch(row + beyond)) / 2.0
    return np.where(inside, patch(row) - around, np.nan)


# By the held-out recording: beams that meet the candidate's rails or bed, and where they came back.


@per_case
def _normals(case: Case) -> Float[np.ndarray, "n 3"]:
    """Return the unit normals of the faces that the beams meet; 0 where they meet nothing."""
    cast, normal = cast_beams(case), np.zeros((len(cast_beams(case).face), 3))
    hit = cast.hit
    normal[hit] = face_normals(surface_caster(case).mesh, cast.face[hit])
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def _beams_on(case: Case, part: str) -> Bool[np.ndarray, " n"]:
    return np.asarray((parts_hit(case) == part) & (hold_frame(case).cell >= 0) & np.isfinite(beam_offsets(case)))


def seen_rail_height(case: Case) -> Samples:
    """Return how far the candidate's rails lie above the returns on them, beam by beam, m."""
    if not has_rails(case):
        return NOTHING
    level = _beams_on(case, "rail") & (np.abs(_normals(case)[:, 2]) > _UPRIGHT)
    return Samples(-beam_offsets(case)[level], hold_frame(case).local[level, 0])


def seen_rail_side(case: Case) -> Samples:
    """Return how far the candidate's rails lie outside the returns on their inner faces, beam by beam, m.

    A sensor that is carried over one rail does not see the inner face of that one.
    """
    if not has_rails(case):
        return NOTHING
    rails = [sensor_path(case).local(points)[:, 1] for points in case.candidate.track.rail.values()]
    middle = np.mean([np.median(left) for left in rails])
    side = np.sign(hold_frame(case).local[:, 1] + hold_frame(case).middle[0] - middle)
    steep = _beams_on(case, "rail") & (np.abs(_normals(case)[:, 2]) < 1.0 - _UPRIGHT)
    inner = steep & (returns(case).heading[:, 1] * side > 0.0)
    return Samples(beam_offsets(case)[inner], hold_frame(case).local[inner, 0])


def seen_bed_error(case: Case) -> Samples:
    """Return the height of the candidate's bed and sleepers over the returns between the rails, medians of 5 cm, m."""
    if not has_rails(case):
        return NOTHING
    rails = _rails_on(case, sensor_path(case))
    frame, offset = hold_frame(case), beam_offsets(case)
    station, left = frame.local[:, 0], frame.local[:, 1] + frame.middle[0]
    middle = np.mean([np.interp(station, one[:, 0], one[:, 1]) for one in rails.values()], axis=0)
    aside = np.abs(left - middle)
    near = (aside > _BETWEEN[0]) & (aside < _BETWEEN[1]) & (frame.cell >= 0) & np.isfinite(offset) & (frame.angle < 0)
    count = int((frame.high - frame.low) / BED_BIN) + 1
    bins = ((station[near] - frame.low) / BED_BIN).astype(int)
    medians = -grouped_median(bins, offset[near], count, _LEAST)
    known = np.isfinite(medians)
    return Samples(medians[known], frame.low + (np.flatnonzero(known) + 0.5) * BED_BIN)
