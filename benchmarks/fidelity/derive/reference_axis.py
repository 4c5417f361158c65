"""The reference's axis: the generator's, or the one that the held-out recording shows; and the axis of the lining."""

import numpy as np
from jaxtyping import Float

from benchmarks.fidelity.case import Case, derived, of_hold, until
from benchmarks.fidelity.derive import profiles
from benchmarks.fidelity.derive.beams import returns
from benchmarks.fidelity.derive.curve import Curve, candidate_curve, truth_curve
from benchmarks.fidelity.derive.surface import Caster

_APART = 0.9  # m between the sensor positions that begin the axis: a second pass adds none
_SMOOTH = 3.0  # m
_CALM = 8.0  # m
_ROUNDS = 3
_MOST_POINTS = 400_000
_KNOWN = 0.6  # share of the sectors that makes a slice count


def reference_curve(case: Case) -> Curve:
    """The generator's axis where there is a truth, otherwise the held-out recording's."""
    return truth_curve(case) if case.truth is not None else hold_curve(case)


@of_hold
def hold_points(case: Case) -> Float[np.ndarray, "k 3"]:
    """Returns of the held-out recording, at most about 400,000, m."""
    points = returns(case).points  # in an order that does not hang on the file's
    return points[:: max(1, -(-len(points) // _MOST_POINTS))]


@of_hold
def sensor_path(case: Case) -> Curve:
    """Where the sensor went, each place once."""
    assert case.hold is not None
    first = np.unique(case.hold.scan, return_index=True)[1]
    kept: list[np.ndarray] = []
    for here in case.hold.origin[np.sort(first)]:
        if all(np.linalg.norm(here - there) > _APART for there in kept):
            kept.append(here)
    if len(kept) < 4:
        raise ValueError("the held-out recording moves too little to show an axis")
    path = curve_through(np.array(kept))
    station = np.linspace(0.0, path.length, max(int(path.length), 4) + 1)
    even = path.frames(station)[0]
    # A vehicle sways; frames that sway with it would cut the bore askew.
    return curve_through(profiles.smoothed(even, station[1], _CALM))


@of_hold
def hold_curve(case: Case) -> Curve:
    """Middle of width and height, re-estimated from the held-out recording by medians of polar radii.

    Method: 0.5 m slices across the sensor's path, median radius of each 5 degree sector, their middle by mirrored
    sectors, repeated about the new axis; a track is cut away from the floor once the floor is known. No code of the
    builder takes part.
    """
    curve, points, floor = sensor_path(case), hold_points(case), None
    angle = profiles.directions(round(2 * np.pi / profiles.SECTOR))
    for _ in range(_ROUNDS):
        local = curve.local(points)
        low, high = np.percentile(local[:, 0], [0.5, 99.5])
        station = np.arange(low, high, profiles.SLICE)
        profile = profiles.windowed(profiles.of_points(local, station, floor), profiles.SLICE)
        seen = np.isfinite(profile).mean(axis=1) > _KNOWN
        if seen.sum() < 4:
            raise ValueError("the held-out recording shows too little of the section")
        keep = slice(np.flatnonzero(seen)[0], np.flatnonzero(seen)[-1] + 1)
        offset = profiles.smoothed(profiles.middle(profile[keep], angle), profiles.SLICE, _SMOOTH)
        floor = float(np.nanmedian(profiles.crown_and_floor(profile[keep], angle)[1])) - float(np.median(offset[:, 1]))
        curve = curve_through(curve.point(np.column_stack([station[keep], offset])))
    return curve


@of_hold
def hold_local(case: Case) -> Float[np.ndarray, "k 3"]:
    """Those returns as station, left and up about the recording's own axis, m."""
    return hold_curve(case).local(hold_points(case))


@until("LIN")
@derived
def lining_caster(case: Case) -> Caster:
    """Rays in the lining alone."""
    return Caster(case.candidate.lining)


@derived
def mouths(case: Case) -> tuple[float, float]:
    """Where the lining begins and ends along the reference axis, m: median over 16 sectors of its first and last."""
    local = reference_curve(case).local(np.asarray(case.candidate.lining.vertices))
    return extent(local)


def extent(local: Float[np.ndarray, "k 3"]) -> tuple[float, float]:
    """First and last station of a surface, m, each the median over 16 sectors."""
    sector = np.minimum(((np.arctan2(local[:, 2], local[:, 1]) + np.pi) / (np.pi / 8)).astype(int), 15)
    low, high = np.full(16, np.inf), np.full(16, -np.inf)
    np.minimum.at(low, sector, local[:, 0])
    np.maximum.at(high, sector, local[:, 0])
    known = np.isfinite(low)
    return float(np.median(low[known])), float(np.median(high[known]))


@derived
def lining_curve(case: Case) -> Curve:
    """The axis of the lining itself: middle of width and height of its sections, mouth to mouth.

    The declared centreline only says from where the sections are looked at.
    """
    declared, angle = candidate_curve(case), profiles.directions(120)
    low, high = extent(declared.local(np.asarray(case.candidate.lining.vertices)))
    station = np.linspace(low, high, max(round((high - low) / profiles.STEP), 4) + 1)
    step = station[1] - station[0]
    inner = station.copy()
    inner[0], inner[-1] = station[0] + 0.01, station[-1] - 0.01  # a ray in the very plane of the mouth may miss
    profile = profiles.windowed(profiles.cast(lining_caster(case), declared, inner, angle), step)
    offset = profiles.smoothed(profiles.middle(profile, angle), step, _SMOOTH / 2)
    return curve_through(declared.point(np.column_stack([station, offset])))


def curve_through(position: Float[np.ndarray, "n 3"]) -> Curve:
    """A curve through points, its stations their chords' sum from 0."""
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    return Curve(np.concatenate([[0.0], np.cumsum(steps)]), position)
