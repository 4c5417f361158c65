"""Changes that change nothing of what is judged: the scores must not move."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.fidelity.candidate import Bore, Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.faults.kinds import Fault, Site, fault_kind, warp
from benchmarks.fidelity.faults.mesh import change_both
from benchmarks.fidelity.faults.references import move_references
from benchmarks.fidelity.references import Hold

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
    """Turns and shifts reconstruction and references alike."""
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
    """Writes meshes as OBJ and as binary STL and reads them again."""

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
    """Return the case with some beams of its recording."""
    if case.hold is None:
        return case
    names, kept = ("time", "scan", "origin", "direction", "range"), rows(case.hold)
    taken = {name: getattr(case.hold, name)[kept] for name in names}
    return replace(case, hold=replace(case.hold, **taken, cache={}), cache={})


@fault_kind("unordered", "beams of the held-out recording in another order", signed=False)
def shuffle_beams(site: Site, fault: Fault) -> Case:
    """Puts the beams of each scan into another order; scans stay in theirs."""
    return _with_beams(site.case, lambda hold: np.lexsort((site.rng.random(len(hold.scan)), hold.scan)))


@fault_kind("thinned", "share of the held-out beams missing", signed=False)
def thin_beams(site: Site, fault: Fault) -> Case:
    return _with_beams(site.case, lambda hold: np.flatnonzero(site.rng.random(len(hold.scan)) < 1.0 - fault.size))
