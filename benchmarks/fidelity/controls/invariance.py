"""Changes that change nothing: the scores must stay."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.fidelity.candidate import Bore, Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.controls.warp import moved_references
from benchmarks.fidelity.references import Hold

SHIFT = np.array([1000.0, -640.0, 35.0])  # m
YAW = np.radians(30.0)
GLOBAL_LIMIT = 0.3
CATEGORY_LIMIT = 1.0
THINNED_LIMIT = 2.0


@dataclass(frozen=True)
class Invariance:
    """A control that must be quiet.

    Attributes:
        change: Of the case.
        text: In words.
        category_limit: Points that a category may move.
        exempt: Categories that may move.
    """

    change: Callable[[Case, np.random.Generator], Case]
    text: str
    category_limit: float = CATEGORY_LIMIT
    exempt: tuple[str, ...] = ()


def _candidate(change: Callable[[Candidate, np.random.Generator], Candidate]) -> Callable[..., Case]:
    return lambda case, rng: replace(case, candidate=change(case.candidate, rng), cache={})


def _meshes(change: Callable[[trimesh.Trimesh], trimesh.Trimesh]) -> Callable[..., Candidate]:
    return lambda candidate, rng: replace(candidate, lining=change(candidate.lining), solid=change(candidate.solid))


def permuted(candidate: Candidate, rng: np.random.Generator) -> Candidate:
    """Vertices and faces in another order."""

    def mixed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        order = rng.permutation(len(mesh.vertices))
        place = np.argsort(order)
        return trimesh.Trimesh(mesh.vertices[order], place[mesh.faces][rng.permutation(len(mesh.faces))], process=False)

    return replace(candidate, lining=mixed(candidate.lining), solid=mixed(candidate.solid))


def subdivided(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Every face in four by the middles of its edges."""
    vertices, faces = trimesh.remesh.subdivide(mesh.vertices, mesh.faces)
    return trimesh.Trimesh(vertices, faces, process=False)


def moved_together(case: Case, rng: np.random.Generator) -> Case:
    """Reconstruction and references turned and shifted alike."""
    turn = Rotation.from_euler("z", YAW).as_matrix()
    candidate = case.candidate

    def move(points: np.ndarray) -> np.ndarray:
        return points @ turn.T + SHIFT

    def mesh(old: trimesh.Trimesh) -> trimesh.Trimesh:
        return trimesh.Trimesh(move(old.vertices), old.faces, process=False) if len(old.faces) else old

    bore, track = candidate.bore, candidate.track
    turned = {name: getattr(bore, name) @ turn.T for name in ("tangent", "lateral", "up")}
    made = replace(
        candidate, lining=mesh(candidate.lining), solid=mesh(candidate.solid), extra=mesh(candidate.extra),
        nails=mesh(candidate.nails), bed=mesh(candidate.bed),
        bore=replace(bore, position=move(bore.position), **turned),
        track=replace(
            track, sleeper=move(track.sleeper) if len(track.sleeper) else track.sleeper,
            sleeper_mesh=mesh(track.sleeper_mesh), rail_mesh=mesh(track.rail_mesh),
            fastening_mesh=mesh(track.fastening_mesh),
            rail={side: move(points) if len(points) else points for side, points in track.rail.items()},
        ),
    )  # fmt: skip
    return replace(moved_references(case, turn, SHIFT), candidate=made)


def reversed_axis(case: Case, rng: np.random.Generator) -> Case:
    """Chainage from the other end, of the reconstruction alone."""
    bore, track = case.candidate.bore, case.candidate.track
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
    return replace(case, candidate=replace(case.candidate, bore=turned, track=laid), cache={})


def exchanged(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Written as OBJ and as binary STL, and read again."""
    for kind in ("obj", "stl"):
        data = mesh.export(file_type=kind)
        assert isinstance(data, str | bytes)
        loaded = trimesh.load_mesh(trimesh.util.wrap_as_stream(data), file_type=kind, process=False)
        mesh = trimesh.Trimesh(loaded.vertices, loaded.faces, process=False)
        mesh.merge_vertices(digits_vertex=5)
    return mesh


def shuffled(hold: Hold, rng: np.random.Generator) -> Hold:
    """Beams of each scan in another order; scans stay in theirs."""
    order = np.lexsort((rng.random(len(hold.scan)), hold.scan))
    return taken(hold, order)


def thinned(hold: Hold, rng: np.random.Generator) -> Hold:
    """Every second beam."""
    return taken(hold, np.flatnonzero(rng.random(len(hold.scan)) < 0.5))


def taken(hold: Hold, rows: np.ndarray) -> Hold:
    """Some beams of a recording."""
    names = ("time", "scan", "origin", "direction", "range")
    return replace(hold, **{name: getattr(hold, name)[rows] for name in names}, cache={})


def _hold(change: Callable[[Hold, np.random.Generator], Hold]) -> Callable[..., Case]:
    return lambda case, rng: case if case.hold is None else replace(case, hold=change(case.hold, rng), cache={})


INVARIANCES: dict[str, Invariance] = {
    "I1": Invariance(_candidate(permuted), "vertices and faces in another order"),
    "I2": Invariance(_candidate(_meshes(subdivided)), "every face in four", exempt=("TRI",)),
    "I3": Invariance(moved_together, "everything 1 km away and turned by 30 degrees"),
    "I4": Invariance(reversed_axis, "chainage from the other end"),
    "I5": Invariance(_candidate(_meshes(exchanged)), "meshes through OBJ and STL"),
    "I6": Invariance(_hold(shuffled), "beams of the held-out recording in another order"),
    "I7": Invariance(_hold(thinned), "half of the held-out beams", category_limit=THINNED_LIMIT),
}
