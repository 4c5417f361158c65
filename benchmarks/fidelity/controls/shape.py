"""Controls of size and shape: scale, width, length, place, roll, curvature."""

from dataclasses import replace

import numpy as np
import trimesh

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.compiled import Track
from benchmarks.fidelity.controls.parts import cut_components
from benchmarks.fidelity.controls.warp import Map, bent, curve, warped
from benchmarks.fidelity.derive.curve import Curve

_FLOOR_RISE = (0.5, 1.3)  # m above the floor between which a raised floor fades into the wall
_WAVE = 100.0  # m


def local_map(candidate: Candidate, change: Map) -> Map:
    """A map of (station, left, up) about the candidate's axis as a map of points."""
    line = curve(candidate)
    return lambda points: line.point(change(line.local(points)))


def scaled(candidate: Candidate, factor: float) -> Candidate:
    """Everything larger about the middle of the axis."""
    middle = candidate.bore.position.mean(axis=0)
    return warped(candidate, lambda points: middle + factor * (points - middle))


def section_scaled(candidate: Candidate, wide: float, high: float) -> Candidate:
    """Every section wider and higher about its axis."""
    return warped(candidate, local_map(candidate, lambda local: local * [1.0, wide, high]))


def axial_stretch(case: Case, factor: float) -> Case:
    """Reconstruction and recording longer together, as a drifting odometry makes them; control stays."""
    candidate = case.candidate
    line, middle = curve(candidate), candidate.bore.position.mean(axis=0)
    longer = Curve(line.station * factor, middle + factor * (line.position - middle))

    def move(points: np.ndarray) -> np.ndarray:
        return longer.point(line.local(points) * [factor, 1.0, 1.0])

    hold = None if case.hold is None else bent(case.hold, move)
    fit = None if case.fit is None else bent(case.fit, move)
    return replace(case, candidate=warped(candidate, move), hold=hold, fit=fit, cache={})


def yawed(candidate: Candidate, angle: float) -> Candidate:
    """Turned about the vertical through the middle of the axis, rad."""
    middle = candidate.bore.position.mean(axis=0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return warped(candidate, lambda points: middle + (points - middle) @ turn.T)


def rolled(candidate: Candidate, angle: float) -> Candidate:
    """Every section turned about its axis, rad."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    return warped(candidate, local_map(candidate, lambda local: local @ turn.T))


def shifted(candidate: Candidate, left: float) -> Candidate:
    """Everything to the left, m."""
    return warped(candidate, local_map(candidate, lambda local: local + np.array([0.0, left, 0.0])))


def floor_raised(candidate: Candidate, rise: float) -> Candidate:
    """Floor and track higher; the walls above 1.3 m stay, m."""
    bottom = -0.5 * float(np.median(candidate.bore.height))

    def change(local: np.ndarray) -> np.ndarray:
        fade = np.interp(local[:, 2] - bottom, _FLOOR_RISE, [1.0, 0.0])
        return local + np.column_stack([np.zeros((len(local), 2)), rise * fade])

    moved = warped(candidate, local_map(candidate, change))
    bore = candidate.bore
    lower = np.sin(bore.angle) < -0.5
    radius = np.where(lower[None], bore.radius + rise * np.minimum(np.sin(bore.angle), 0.0), bore.radius)
    return replace(moved, bore=replace(bore, height=bore.height - rise, radius=radius))


def shortened(candidate: Candidate, share: float) -> Candidate:
    """The last part cut off."""
    bore = candidate.bore
    end = candidate.length * (1.0 - share)
    line = curve(candidate)
    position, tangent, *_ = line.frames(np.array([end]))
    kept = bore.station <= end

    def cut(mesh: trimesh.Trimesh, cap: bool) -> trimesh.Trimesh:
        return trimesh.intersections.slice_mesh_plane(mesh, -tangent[0], position[0], cap=cap, engine="manifold")

    rows = ("station", "position", "tangent", "lateral", "up", "width", "height", "radius")
    short = replace(
        bore,
        **{name: getattr(bore, name)[kept] for name in rows},
        ring_station=bore.ring_station[bore.ring_station <= end],
        pocket=bore.pocket[bore.pocket["station"] <= end] if len(bore.pocket) else bore.pocket,
    )
    return replace(
        candidate, lining=cut(candidate.lining, False), solid=_capped_cut(candidate, cut), bore=short,
        track=_short_track(candidate.track, line, end),
        nails=cut_components(candidate.nails, lambda middles: line.local(middles)[:, 0] <= end),
    )  # fmt: skip


def straightened(candidate: Candidate, share: float) -> Candidate:
    """The axis taken towards a straight line of the same length and mean direction; 1 leaves no curvature."""
    line = curve(candidate)
    chord = line.position[-1] - line.position[0]
    chord /= np.linalg.norm(chord)
    middle = line.station - line.station.mean()
    straight = line.position.mean(axis=0) + middle[:, None] * chord
    target = Curve(line.station, (1.0 - share) * line.position + share * straight)
    return warped(candidate, lambda points: target.point(line.local(points)))


def waved(candidate: Candidate, amplitude: float) -> Candidate:
    """A sideways wave of 100 m length, amplitude in m."""

    def change(local: np.ndarray) -> np.ndarray:
        aside = amplitude * np.sin(2.0 * np.pi * local[:, 0] / _WAVE)
        return local + np.column_stack([np.zeros(len(local)), aside, np.zeros(len(local))])

    return warped(candidate, local_map(candidate, change))


def _capped_cut(candidate: Candidate, cut) -> trimesh.Trimesh:
    welded = candidate.solid.copy()
    welded.merge_vertices(digits_vertex=6)
    return cut(welded, True)


def _short_track(track: Track, line: Curve, end: float) -> Track:
    def before(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        return cut_components(mesh, lambda middles: line.local(middles)[:, 0] <= end)

    rail = {side: points[line.local(points)[:, 0] <= end] for side, points in track.rail.items() if len(points)}
    return replace(
        track,
        sleeper=track.sleeper[line.local(track.sleeper)[:, 0] <= end] if len(track.sleeper) else track.sleeper,
        sleeper_mesh=before(track.sleeper_mesh), rail=rail or track.rail,
        rail_mesh=before(track.rail_mesh), fastening_mesh=before(track.fastening_mesh),
    )  # fmt: skip
