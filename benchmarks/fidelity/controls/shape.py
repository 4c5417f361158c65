"""Controls of size and shape, and maps of space applied to all of a candidate."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from benchmarks.fidelity.candidate import Bore, Candidate, Track
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.references import Hold, Truth

Points = Float[np.ndarray, "n 3"]
PointMap = Callable[[Points], Points]
_ARM = 1.0  # m from the axis at which a section's stretch is measured


def axis_of(candidate: Candidate) -> Curve:
    """Return the candidate's centreline."""
    return Curve(candidate.bore.station, candidate.bore.position)


def warp(candidate: Candidate, move: PointMap) -> Candidate:
    """Moves every point of a candidate; stations become arc length of the moved axis."""
    return replace(
        candidate,
        lining=warp_mesh(candidate.lining, move),
        solid=warp_mesh(candidate.solid, move),
        bore=warp_bore(candidate.bore, move),
        track=warp_track(candidate.track, move),
        extra=warp_mesh(candidate.extra, move),
        nails=warp_mesh(candidate.nails, move),
        bed=warp_mesh(candidate.bed, move),
    )


def warp_mesh(mesh: trimesh.Trimesh, move: PointMap) -> trimesh.Trimesh:
    """Moves the vertices of a mesh."""
    if not len(mesh.faces):
        return mesh
    return trimesh.Trimesh(move(np.asarray(mesh.vertices, float)), mesh.faces, process=False)


def warp_track(track: Track, move: PointMap) -> Track:
    """Moves every point of the track; its gauge becomes the distance of the moved rails."""
    rail = {side: move(points) if len(points) else points for side, points in track.rail.items()}
    return replace(
        track,
        sleeper=move(track.sleeper) if len(track.sleeper) else track.sleeper,
        sleeper_mesh=warp_mesh(track.sleeper_mesh, move),
        rail=rail,
        rail_mesh=warp_mesh(track.rail_mesh, move),
        fastening_mesh=warp_mesh(track.fastening_mesh, move),
    )


def warp_bore(bore: Bore, move: PointMap) -> Bore:
    """Moves axis and frames; width, height and radii grow as the map stretches a section at its axis."""
    position = move(bore.position)
    station = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=1))])
    tangent = _unit(np.gradient(position, station, axis=0))
    lateral = _unit(np.cross([0.0, 0.0, 1.0], tangent))
    up = np.cross(tangent, lateral)
    wide, high = (_stretch(bore, axis, move) for axis in (bore.lateral, bore.up))
    across, along = np.cos(bore.angle)[None] * wide[:, None], np.sin(bore.angle)[None] * high[:, None]
    radius = bore.radius * np.hypot(across, along)

    def moved(old: np.ndarray) -> np.ndarray:
        return np.interp(old, bore.station, station)

    pocket = bore.pocket.copy()
    if len(pocket):
        pocket["station"] = moved(pocket["station"])
    return Bore(
        station, position, tangent, lateral, up, bore.width * wide, bore.height * high, bore.angle, radius,
        moved(bore.ring_station), pocket,
    )  # fmt: skip


def move_references(case: Case, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> Case:
    """Turns held-out recording, fit and truth about the origin and shifts them."""
    hold, fit = (None if h is None else move_hold(h, turn, shift) for h in (case.hold, case.fit))
    truth = None if case.truth is None else move_truth(case.truth, turn, shift)
    return replace(case, hold=hold, fit=fit, truth=truth, cache={})


def move_hold(hold: Hold, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> Hold:
    """Turns a recording about the origin and shifts it; kept results are dropped."""
    return replace(hold, origin=hold.origin @ turn.T + shift, direction=hold.direction @ turn.T, cache={})


def move_truth(truth: Truth, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> Truth:
    """Turns a truth about the origin of the tunnel frame and shifts it; kept results are dropped."""
    surface = warp_mesh(truth.surface, lambda points: points @ turn.T + shift)
    return replace(
        truth, position=truth.position @ turn.T + shift, tangent=truth.tangent @ turn.T, surface=surface,
        furniture=_turn_positions(truth.furniture, truth.origin, turn, shift), cache={},
    )  # fmt: skip


def bend_recording(hold: Hold, move: PointMap) -> Hold:
    """Moves sensor positions and returns of a recording, and the beams with them."""
    origin, end = (
        move(hold.origin),
        move(hold.origin + np.where(hold.returned, hold.range, 1.0)[:, None] * hold.direction),
    )
    away = end - origin
    reach = np.linalg.norm(away, axis=1)
    direction = away / np.maximum(reach, 1e-9)[:, None]
    return replace(hold, origin=origin, direction=direction, range=np.where(hold.returned, reach, hold.range), cache={})


def _turn_positions(value: Any, origin: np.ndarray, turn: np.ndarray, shift: np.ndarray, key: str = "") -> Any:
    """Turns the positions of truth.json (survey frame) with the rest."""
    if isinstance(value, dict):
        return {name: _turn_positions(inner, origin, turn, shift, name) for name, inner in value.items()}
    if key in ("position", "left", "right"):
        return (
            ((np.asarray(value, float).reshape(-1, 3) - origin) @ turn.T + shift + origin)
            .reshape(np.shape(value))
            .tolist()
        )
    if key == "outward":
        return (turn @ np.asarray(value, float)).tolist()
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return [_turn_positions(inner, origin, turn, shift) for inner in value]
    return value


def _stretch(bore: Bore, axis: np.ndarray, move: PointMap) -> np.ndarray:
    ends = [move(bore.position + sign * _ARM * axis) for sign in (-1.0, 1.0)]
    return np.linalg.norm(ends[1] - ends[0], axis=1) / (2.0 * _ARM)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


# Meshes of many bodies: which there are, some removed, each moved by itself.


def find_bodies(mesh: trimesh.Trimesh) -> tuple[Int[np.ndarray, " v"], Float[np.ndarray, "b 3"]]:
    """Return the number of the body of each vertex, and the middle of each body, m."""
    count = len(mesh.vertices)
    if not count:
        return np.zeros(0, int), np.zeros((0, 3))
    welded = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)[1].ravel()
    first, second = welded[mesh.faces[:, [0, 0]].ravel()], welded[mesh.faces[:, [1, 2]].ravel()]
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(count, count))
    label = np.unique(connected_components(graph, directed=False)[1][welded], return_inverse=True)[1]
    size = np.maximum(np.bincount(label), 1)[:, None]
    return label, np.stack([np.bincount(label, axis) for axis in mesh.vertices.T], axis=1) / size


def keep_bodies(
    mesh: trimesh.Trimesh, keep: Callable[[Float[np.ndarray, "b 3"]], Bool[np.ndarray, " b"]]
) -> trimesh.Trimesh:
    """Keeps the bodies whose middle passes a test."""
    if not len(mesh.faces):
        return mesh
    label, middle = find_bodies(mesh)
    return without_faces(mesh, ~keep(middle)[label[mesh.faces[:, 0]]])


def move_bodies(
    mesh: trimesh.Trimesh, shift: Callable[[Float[np.ndarray, "b 3"]], Float[np.ndarray, "b 3"]]
) -> trimesh.Trimesh:
    """Moves each body by the shift of its middle."""
    if not len(mesh.faces):
        return mesh
    label, middle = find_bodies(mesh)
    return trimesh.Trimesh(mesh.vertices + shift(middle)[label], mesh.faces, process=False)


def without_faces(mesh: trimesh.Trimesh, gone: Bool[np.ndarray, " f"]) -> trimesh.Trimesh:
    """Removes some faces, and the vertices that no face uses then."""
    left = trimesh.Trimesh(mesh.vertices, mesh.faces[~gone], process=False)
    left.remove_unreferenced_vertices()
    return left


# Controls of size and shape: scale, width, length, place, roll, curvature.

_FLOOR_RISE = (0.5, 1.3)  # m above the floor between which a raised floor fades into the wall
_WAVE = 100.0  # m


def local_map(candidate: Candidate, change: PointMap) -> PointMap:
    """Return a map of points from a map of (station, left, up) about the candidate's axis."""
    line = axis_of(candidate)
    return lambda points: line.point(change(line.local(points)))


def scale_all(candidate: Candidate, factor: float) -> Candidate:
    """Scales everything about the middle of the axis."""
    middle = candidate.bore.position.mean(axis=0)
    return warp(candidate, lambda points: middle + factor * (points - middle))


def scale_section(candidate: Candidate, wide: float, high: float) -> Candidate:
    """Scales width and height of every section about its axis."""
    return warp(candidate, local_map(candidate, lambda local: local * [1.0, wide, high]))


def stretch_axis(case: Case, factor: float) -> Case:
    """Lengthens reconstruction and recording together, as a drifting odometry does; control stays."""
    candidate = case.candidate
    line, middle = axis_of(candidate), candidate.bore.position.mean(axis=0)
    longer = Curve(line.station * factor, middle + factor * (line.position - middle))

    def move(points: np.ndarray) -> np.ndarray:
        return longer.point(line.local(points) * [factor, 1.0, 1.0])

    hold = None if case.hold is None else bend_recording(case.hold, move)
    fit = None if case.fit is None else bend_recording(case.fit, move)
    return replace(case, candidate=warp(candidate, move), hold=hold, fit=fit, cache={})


def turn_yaw(candidate: Candidate, angle: float) -> Candidate:
    """Turns everything about the vertical through the middle of the axis, rad."""
    middle = candidate.bore.position.mean(axis=0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return warp(candidate, lambda points: middle + (points - middle) @ turn.T)


def roll_sections(candidate: Candidate, angle: float) -> Candidate:
    """Turns every section about its axis, rad."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    return warp(candidate, local_map(candidate, lambda local: local @ turn.T))


def shift_left(candidate: Candidate, left: float) -> Candidate:
    """Shifts everything to the left, m."""
    return warp(candidate, local_map(candidate, lambda local: local + np.array([0.0, left, 0.0])))


def raise_floor(candidate: Candidate, rise: float) -> Candidate:
    """Raises floor and track; the walls above 1.3 m stay, m."""
    bottom = -0.5 * float(np.median(candidate.bore.height))

    def change(local: np.ndarray) -> np.ndarray:
        fade = np.interp(local[:, 2] - bottom, _FLOOR_RISE, [1.0, 0.0])
        return local + np.column_stack([np.zeros((len(local), 2)), rise * fade])

    moved = warp(candidate, local_map(candidate, change))
    bore = candidate.bore
    lower = np.sin(bore.angle) < -0.5
    radius = np.where(lower[None], bore.radius + rise * np.minimum(np.sin(bore.angle), 0.0), bore.radius)
    return replace(moved, bore=replace(bore, height=bore.height - rise, radius=radius))


def shorten(candidate: Candidate, share: float) -> Candidate:
    """Cuts off the last part."""
    bore = candidate.bore
    end = candidate.length * (1.0 - share)
    line = axis_of(candidate)
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
        candidate, lining=cut(candidate.lining, False), solid=_cut_solid(candidate, cut), bore=short,
        track=_short_track(candidate.track, line, end),
        nails=keep_bodies(candidate.nails, lambda middles: line.local(middles)[:, 0] <= end),
    )  # fmt: skip


def straighten(candidate: Candidate, share: float) -> Candidate:
    """Moves the axis towards a straight line of the same length and mean direction; 1 leaves no curvature."""
    line = axis_of(candidate)
    chord = line.position[-1] - line.position[0]
    chord /= np.linalg.norm(chord)
    middle = line.station - line.station.mean()
    straight = line.position.mean(axis=0) + middle[:, None] * chord
    target = Curve(line.station, (1.0 - share) * line.position + share * straight)
    return warp(candidate, lambda points: target.point(line.local(points)))


def add_wave(candidate: Candidate, amplitude: float) -> Candidate:
    """Adds a sideways wave of 100 m length, amplitude in m."""

    def change(local: np.ndarray) -> np.ndarray:
        aside = amplitude * np.sin(2.0 * np.pi * local[:, 0] / _WAVE)
        return local + np.column_stack([np.zeros(len(local)), aside, np.zeros(len(local))])

    return warp(candidate, local_map(candidate, change))


def _cut_solid(candidate: Candidate, cut) -> trimesh.Trimesh:
    welded = candidate.solid.copy()
    welded.merge_vertices(digits_vertex=6)
    return cut(welded, True)


def _short_track(track: Track, line: Curve, end: float) -> Track:
    def before(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        return keep_bodies(mesh, lambda middles: line.local(middles)[:, 0] <= end)

    rail = {side: points[line.local(points)[:, 0] <= end] for side, points in track.rail.items() if len(points)}
    return replace(
        track,
        sleeper=track.sleeper[line.local(track.sleeper)[:, 0] <= end] if len(track.sleeper) else track.sleeper,
        sleeper_mesh=before(track.sleeper_mesh), rail=rail or track.rail,
        rail_mesh=before(track.rail_mesh), fastening_mesh=before(track.fastening_mesh),
    )  # fmt: skip
