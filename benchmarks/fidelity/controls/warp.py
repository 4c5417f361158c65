"""One map of space applied to all of a candidate: lining, solid, bore, track and what stands in it."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from benchmarks.fidelity.candidate import Bore, Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.compiled import Track
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.references import Hold, Truth

Points = Float[np.ndarray, "n 3"]
Map = Callable[[Points], Points]
_ARM = 1.0  # m from the axis at which a section's stretch is measured


def curve(candidate: Candidate) -> Curve:
    """The candidate's centreline."""
    return Curve(candidate.bore.station, candidate.bore.position)


def warped(candidate: Candidate, move: Map) -> Candidate:
    """The candidate with every point moved; stations become arc length of the moved axis."""
    return replace(
        candidate,
        lining=warped_mesh(candidate.lining, move),
        solid=warped_mesh(candidate.solid, move),
        bore=warped_bore(candidate.bore, move),
        track=warped_track(candidate.track, move),
        extra=warped_mesh(candidate.extra, move),
        nails=warped_mesh(candidate.nails, move),
        bed=warped_mesh(candidate.bed, move),
    )


def warped_mesh(mesh: trimesh.Trimesh, move: Map) -> trimesh.Trimesh:
    """The mesh with its vertices moved."""
    if not len(mesh.faces):
        return mesh
    return trimesh.Trimesh(move(np.asarray(mesh.vertices, float)), mesh.faces, process=False)


def warped_track(track: Track, move: Map) -> Track:
    """The track with every point moved; its gauge becomes the distance of the moved rails."""
    rail = {side: move(points) if len(points) else points for side, points in track.rail.items()}
    return replace(
        track,
        sleeper=move(track.sleeper) if len(track.sleeper) else track.sleeper,
        sleeper_mesh=warped_mesh(track.sleeper_mesh, move),
        rail=rail,
        rail_mesh=warped_mesh(track.rail_mesh, move),
        fastening_mesh=warped_mesh(track.fastening_mesh, move),
    )


def warped_bore(bore: Bore, move: Map) -> Bore:
    """Axis and frames moved; width, height and radii grow as the map stretches a section at its axis."""
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


def moved_references(case: Case, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> Case:
    """The case with held-out recording, fit and truth turned about the origin and shifted."""
    hold, fit = (None if h is None else moved_hold(h, turn, shift) for h in (case.hold, case.fit))
    truth = None if case.truth is None else moved_truth(case.truth, turn, shift)
    return replace(case, hold=hold, fit=fit, truth=truth, cache={})


def moved_hold(hold: Hold, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> Hold:
    """A recording turned about the origin and shifted, with nothing computed of it yet."""
    return replace(hold, origin=hold.origin @ turn.T + shift, direction=hold.direction @ turn.T, cache={})


def moved_truth(truth: Truth, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> Truth:
    """A truth turned about the origin of the tunnel frame and shifted, with nothing computed of it yet."""
    surface = warped_mesh(truth.surface, lambda points: points @ turn.T + shift)
    return replace(
        truth, position=truth.position @ turn.T + shift, tangent=truth.tangent @ turn.T, surface=surface,
        furniture=_turned(truth.furniture, truth.origin, turn, shift), cache={},
    )  # fmt: skip


def bent(hold: Hold, move: Map) -> Hold:
    """A recording whose sensor positions and returns are moved, and the beams with them."""
    origin, end = (
        move(hold.origin),
        move(hold.origin + np.where(hold.returned, hold.range, 1.0)[:, None] * hold.direction),
    )
    away = end - origin
    reach = np.linalg.norm(away, axis=1)
    direction = away / np.maximum(reach, 1e-9)[:, None]
    return replace(hold, origin=origin, direction=direction, range=np.where(hold.returned, reach, hold.range), cache={})


def _turned(value: Any, origin: np.ndarray, turn: np.ndarray, shift: np.ndarray, key: str = "") -> Any:
    """Positions of truth.json (survey frame) turned with the rest."""
    if isinstance(value, dict):
        return {name: _turned(inner, origin, turn, shift, name) for name, inner in value.items()}
    if key in ("position", "left", "right"):
        return (
            ((np.asarray(value, float).reshape(-1, 3) - origin) @ turn.T + shift + origin)
            .reshape(np.shape(value))
            .tolist()
        )
    if key == "outward":
        return (turn @ np.asarray(value, float)).tolist()
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return [_turned(inner, origin, turn, shift) for inner in value]
    return value


def _stretch(bore: Bore, axis: np.ndarray, move: Map) -> np.ndarray:
    ends = [move(bore.position + sign * _ARM * axis) for sign in (-1.0, 1.0)]
    return np.linalg.norm(ends[1] - ends[0], axis=1) / (2.0 * _ARM)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
