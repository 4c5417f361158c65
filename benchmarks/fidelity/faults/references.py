"""Faults of the references, cheats, other candidates, and changes that change nothing of what is judged."""

from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from benchmarks.fidelity.candidate import Bore, Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.surface import Caster, visible_mesh
from benchmarks.fidelity.faults.kinds import Fault, PointMap, Site, fault_kind, warp, warp_mesh
from benchmarks.fidelity.faults.mesh import change_both
from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.impostors import null_tube
from benchmarks.fidelity.references import Hold


@fault_kind("turned", "held-out beams turned about the sensor's vertical and side axis", "rad")
def turn_beams(site: Site, fault: Fault) -> Case:
    hold = _require_hold(site.case)
    turn = Rotation.from_euler("zy", [fault.size, fault.size]).as_matrix()
    return replace(site.case, hold=replace(hold, direction=hold.direction @ turn.T, cache={}), cache={})


@fault_kind("shuffled", "scans at each other's places", signed=False)
def permute_poses(site: Site, fault: Fault) -> Case:
    hold = _require_hold(site.case)
    scans, first, index = np.unique(hold.scan, return_index=True, return_inverse=True)
    place = hold.origin[first][site.rng.permutation(len(scans))]
    origin = hold.origin - hold.origin[first][index] + place[index]
    return replace(site.case, hold=replace(hold, origin=origin, cache={}), cache={})


@fault_kind("foreign", "another tunnel of the same class", signed=False)
def judge_foreign(site: Site, fault: Fault) -> Case:
    """Judges another tunnel by this one's references, moved to its mouth and direction."""
    assert site.foreign is not None
    other = site.foreign()
    here, there = site.candidate.bore, other.bore
    turn = _yaw_matrix(there.tangent[0]) @ _yaw_matrix(here.tangent[0]).T
    shift = there.position[0] - turn @ here.position[0]
    return replace(move_references(site.case, turn, shift), candidate=other)


@fault_kind("tube", "null tube; 1 with sleepers, 2 without", signed=False)
def judge_tube(site: Site, fault: Fault) -> Candidate:
    return null_tube(site.candidate, sleepers=fault.size < 2)


@fault_kind("forged", "recording cast in the candidate itself, with its noise times a factor", signed=False)
def forge_recording(site: Site, fault: Fault) -> Case:
    """Replaces the recording by beams cast in the candidate itself, with range noise or without."""
    hold = _require_hold(site.case)
    reach, _ = Caster(visible_mesh(site.candidate)).first(hold.origin, hold.direction)
    reach = reach + site.rng.normal(0.0, 1.0, len(reach)) * (fault.size * hold.sigma)
    keep = np.isfinite(reach)
    columns: dict[str, Any] = {name: getattr(hold, name)[keep] for name in ("time", "scan", "origin", "direction")}
    forged = replace(hold, **columns, range=reach[keep], hash=sha256(reach.tobytes()).hexdigest(), cache={})
    return replace(site.case, hold=forged, cache={})


@fault_kind("leaked", "builder read the held-out recording", signed=False)
def leak_hold(site: Site, fault: Fault) -> Case:
    """Gives the builder the held-out recording: the manifest's inputs hold its hash, and the fit is the hold."""
    hold = _require_hold(site.case)
    manifest = dict(site.candidate.manifest)
    manifest["inputs"] = [*manifest.get("inputs", []), {"file": "hold", "sha256": hold.hash}]
    return replace(site.case, candidate=replace(site.candidate, manifest=manifest), fit=hold, cache={})


def _require_hold(case: Case) -> Hold:
    if case.hold is None:
        raise FidelityError("this control needs a held-out recording, give one with --recording and --trajectory")
    return case.hold


def _yaw_matrix(tangent: np.ndarray) -> np.ndarray:
    return Rotation.from_euler("z", np.arctan2(tangent[1], tangent[0])).as_matrix()


def move_references(case: Case, turn: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> Case:
    """Turns held-out recording, fit and truth about the origin and shifts them."""
    hold, fit = (
        None if h is None else replace(h, origin=h.origin @ turn.T + shift, direction=h.direction @ turn.T, cache={})
        for h in (case.hold, case.fit)
    )
    truth = case.truth
    if truth is not None:
        surface = warp_mesh(truth.surface, lambda points: points @ turn.T + shift)
        truth = replace(
            truth, position=truth.position @ turn.T + shift, tangent=truth.tangent @ turn.T, surface=surface,
            furniture=_turn_positions(truth.furniture, truth.origin, turn, shift), cache={},
        )  # fmt: skip
    return replace(case, hold=hold, fit=fit, truth=truth, cache={})


def bend_recording(hold: Hold, move: PointMap) -> Hold:
    """Moves sensor positions and returns of a recording, and the beams with them."""
    ends = hold.origin + np.where(hold.returned, hold.range, 1.0)[:, None] * hold.direction
    origin = move(hold.origin)
    away = move(ends) - origin
    reach = np.linalg.norm(away, axis=1)
    direction = away / np.maximum(reach, 1e-9)[:, None]
    return replace(hold, origin=origin, direction=direction, range=np.where(hold.returned, reach, hold.range), cache={})


def _turn_positions(value: Any, origin: np.ndarray, turn: np.ndarray, shift: np.ndarray, key: str = "") -> Any:
    """Turns the positions of truth.json (survey frame) with the rest."""
    if isinstance(value, dict):
        return {name: _turn_positions(inner, origin, turn, shift, name) for name, inner in value.items()}
    if key in ("position", "left", "right"):
        moved = (np.asarray(value, float).reshape(-1, 3) - origin) @ turn.T + shift + origin
        return moved.reshape(np.shape(value)).tolist()
    if key == "outward":
        return (turn @ np.asarray(value, float)).tolist()
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return [_turn_positions(inner, origin, turn, shift) for inner in value]
    return value


# Changes that change nothing of what is judged: the scores must not move.

SHIFT = np.array([1000.0, -640.0, 35.0])  # m
YAW = np.radians(30.0)


@fault_kind("permuted", "vertices and faces in another order", signed=False)
def permute(site: Site, fault: Fault) -> Candidate:

    def mixed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        order = site.rng.permutation(len(mesh.vertices))
        faces = np.argsort(order)[mesh.faces][site.rng.permutation(len(mesh.faces))]
        return trimesh.Trimesh(mesh.vertices[order], faces, process=False)

    return change_both(site.candidate, mixed)


@fault_kind("subdivided", "every face in four", signed=False)
def subdivide(site: Site, fault: Fault) -> Candidate:

    def cut(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        vertices, faces = trimesh.remesh.subdivide(mesh.vertices, mesh.faces)
        return trimesh.Trimesh(vertices, faces, process=False)

    return change_both(site.candidate, cut)


@fault_kind("elsewhere", "everything 1 km away and turned by 30 degrees", signed=False)
def move_together(site: Site, fault: Fault) -> Case:
    turn, bore = Rotation.from_euler("z", YAW).as_matrix(), site.candidate.bore
    moved = warp(site.candidate, lambda points: points @ turn.T + SHIFT)
    turned = {name: getattr(bore, name) @ turn.T for name in ("tangent", "lateral", "up")}
    placed = replace(bore, position=bore.position @ turn.T + SHIFT, **turned)
    return replace(move_references(site.case, turn, SHIFT), candidate=replace(moved, bore=placed))


@fault_kind("reversed", "chainage from the other end", signed=False)
def reverse_axis(site: Site, fault: Fault) -> Candidate:
    bore, track = site.candidate.bore, site.candidate.track
    angle = np.pi - bore.angle
    angle = (angle + np.pi) % (2.0 * np.pi) - np.pi
    order = np.argsort(angle)
    pocket = bore.pocket[::-1].copy()
    if len(pocket):
        pocket["station"] = bore.station[-1] - pocket["station"]
        pocket["angle"] = (2.0 * np.pi - pocket["angle"]) % (2.0 * np.pi) - np.pi
    turned = Bore(
        bore.station[-1] - bore.station[::-1], bore.position[::-1], -bore.tangent[::-1], -bore.lateral[::-1],
        bore.up[::-1],
        bore.width[::-1], bore.height[::-1], angle[order], bore.radius[::-1][:, order],
        bore.station[-1] - bore.ring_station[::-1], pocket,
    )  # fmt: skip
    rail = {"left": track.rail["right"][::-1], "right": track.rail["left"][::-1]}
    laid = replace(track, sleeper=track.sleeper[::-1], rail=rail)
    return replace(site.candidate, bore=turned, track=laid)


@fault_kind("exchanged", "meshes through OBJ and STL", signed=False)
def exchange_formats(site: Site, fault: Fault) -> Candidate:
    def exchanged(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        for kind in ("obj", "stl"):
            data = mesh.export(file_type=kind)
            assert isinstance(data, str | bytes)
            loaded = trimesh.load_mesh(trimesh.util.wrap_as_stream(data), file_type=kind, process=False)
            mesh = trimesh.Trimesh(loaded.vertices, loaded.faces, process=False)
            mesh.merge_vertices(digits_vertex=5)
        return mesh

    return change_both(site.candidate, exchanged)


def _with_beams(case: Case, rows: Callable[[Hold], np.ndarray]) -> Case:
    if case.hold is None:
        return case
    names, kept = ("time", "scan", "origin", "direction", "range"), rows(case.hold)
    taken = {name: getattr(case.hold, name)[kept] for name in names}
    return replace(case, hold=replace(case.hold, **taken, cache={}), cache={})


@fault_kind("unordered", "beams of the held-out recording in another order", signed=False)
def shuffle_beams(site: Site, fault: Fault) -> Case:
    """Puts the beams of each scan into another order; scans stay in theirs."""
    return _with_beams(site.case, lambda hold: np.lexsort((site.rng.random(len(hold.scan)), hold.scan)))


@fault_kind("thinned", "fraction of the held-out beams missing", signed=False)
def thin_beams(site: Site, fault: Fault) -> Case:
    return _with_beams(site.case, lambda hold: np.flatnonzero(site.rng.random(len(hold.scan)) < 1.0 - fault.size))
