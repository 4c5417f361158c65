"""The table of negative controls with the functions that carry them out, and the invariances."""

import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.fidelity.candidate import Bore, Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.controls.assets import (
    add_debris,
    add_pillars,
    block_bore,
    change_gauge,
    close_mouth,
    remove_sleepers,
    respace_sleepers,
    ring_pitch,
    scale_pockets,
    shift_pattern,
)
from benchmarks.fidelity.controls.damage import (
    add_fins,
    add_vertex_noise,
    coarsen,
    collide_whole_mesh,
    cut_hole,
    double_faces,
    drop_faces,
    drop_scene_faces,
    flip_faces,
    forge_recording,
    judge_foreign,
    leak_hold,
    move_panels,
    permute_poses,
    scale_scene,
    turn_beams,
    widen_plan,
)
from benchmarks.fidelity.controls.shape import (
    add_wave,
    move_references,
    raise_floor,
    roll_sections,
    scale_all,
    scale_section,
    shift_left,
    shorten,
    straighten,
    stretch_axis,
    turn_yaw,
)
from benchmarks.fidelity.impostors import null_tube
from benchmarks.fidelity.references import Hold

TABLE = Path(__file__).with_name("controls.csv")
OUT_OF_SCENE = "all but SCN PAR"
QUIET_LIMIT = 2.0  # points that a category named as quiet may move
MONOTONE = -0.9
UNORDERED = ("N20", "N26", "N32", "N34", "N35")  # their doses are kinds, not amounts


@dataclass(frozen=True)
class Setting:
    """Means of a control beside the case.

    Attributes:
        rng: Random numbers of the control; the same for all doses.
        scratch: A folder to write a changed scene into.
        foreign: Function that loads another tunnel of the same class; only N33 calls it.
    """

    rng: np.random.Generator
    scratch: Path
    foreign: Callable[[], Candidate]


@dataclass(frozen=True)
class Control:
    """Row of the table of controls.

    Attributes:
        id: N01 to N36.
        corruption: Corruption in words.
        doses: Doses in growing severity.
        bold: Doses that must FAIL.
        falls: Points that a category must lose at least at the bold dose.
        quiet: Categories that may move by at most 2 points.
        evaluated: Categories to compute; the others keep the base's values, since nothing they read has changed.
        reason: Reason for a difference from the specification; empty where there is none.
    """

    id: str
    corruption: str
    doses: tuple[float, ...]
    bold: tuple[float, ...]
    falls: dict[str, float]
    quiet: tuple[str, ...]
    evaluated: str
    reason: str


Spoil = Callable[[Case, float, Setting], Case]


@cache
def load_controls() -> dict[str, Control]:
    """Return the controls by id, in order."""
    with TABLE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        row["id"]: Control(
            row["id"], row["corruption"], _parse_numbers(row["doses"]), _parse_numbers(row["bold"]),
            {pair.split()[0]: float(pair.split()[1]) for pair in row["falls"].split(";") if pair.strip()},
            tuple(row["quiet"].split()), row["evaluated"], row["reason"],
        )
        for row in rows
    }  # fmt: skip


def spoil_case(case: Case, control: str, dose: float, setting: Setting) -> Case:
    """Return the case with one control at one dose.

    Raises:
        KeyError: No such control.
    """
    return SPOIL[control](case, dose, setting)


def _parse_numbers(text: str) -> tuple[float, ...]:
    return tuple(float(word) for word in text.split())


def _change_candidate(change: Callable[[Candidate, float, Setting], Candidate]) -> Spoil:
    return lambda case, dose, setting: replace(case, candidate=change(case.candidate, dose, setting), cache={})


def _scale_all(candidate: Candidate, dose: float, setting: Setting) -> Candidate:
    factor = 1.0 + dose / 100.0
    scene = scale_scene(candidate, factor, setting.scratch)
    moved = scale_all(candidate, factor)
    return replace(moved, folder=scene.folder, scene=scene.scene, tunnel=scene.tunnel)


def _drop_faces(candidate: Candidate, dose: float, setting: Setting) -> Candidate:
    holed = drop_scene_faces(candidate, dose / 100.0, setting.rng, setting.scratch)
    return drop_faces(holed, dose / 100.0, setting.rng)


def _spoil_poses(case: Case, dose: float, setting: Setting) -> Case:
    return turn_beams(case, np.radians(2.0)) if dose < 2 else permute_poses(case, setting.rng)


def _forge_recording(case: Case, dose: float, setting: Setting) -> Case:
    assert case.hold is not None
    return forge_recording(case, case.hold.sigma if dose >= 2 else 0.0, setting.rng)


def _spoil_pockets(candidate: Candidate, dose: float, setting: Setting) -> Candidate:
    if dose >= 3.0:
        return shift_pattern(candidate, 0.5 * ring_pitch(candidate))
    return scale_pockets(candidate, dose, 1.0, setting.rng)


SPOIL: dict[str, Spoil] = {
    "N01": _change_candidate(_scale_all),
    "N02": _change_candidate(lambda c, d, s: scale_section(c, 1 + d / 100, 1 + d / 100)),
    "N03": _change_candidate(lambda c, d, s: scale_section(c, 1 + d / 100, 1.0)),
    "N04": lambda case, d, s: stretch_axis(case, 1 + d / 100),
    "N05": _change_candidate(lambda c, d, s: turn_yaw(c, np.radians(d))),
    "N06": _change_candidate(lambda c, d, s: roll_sections(c, np.radians(d))),
    "N07": _change_candidate(lambda c, d, s: shift_left(c, d)),
    "N08": _change_candidate(lambda c, d, s: raise_floor(c, d)),
    "N09": _change_candidate(lambda c, d, s: shorten(c, d / 100)),
    "N10": _change_candidate(lambda c, d, s: straighten(c, d / 100)),
    "N11": _change_candidate(lambda c, d, s: add_wave(c, d)),
    "N12": _change_candidate(_drop_faces),
    "N13": _change_candidate(lambda c, d, s: cut_hole(c, d, s.rng)),
    "N14": _change_candidate(lambda c, d, s: flip_faces(c, 1.0, s.rng)),
    "N15": _change_candidate(lambda c, d, s: flip_faces(c, d / 100, s.rng)),
    "N16": _change_candidate(lambda c, d, s: double_faces(c, d / 100, s.rng)),
    "N17": _change_candidate(lambda c, d, s: add_fins(c, int(d), s.rng)),
    "N18": _change_candidate(lambda c, d, s: add_vertex_noise(c, d, s.rng)),
    "N19": _change_candidate(lambda c, d, s: coarsen(c, d / 100)),
    "N20": _change_candidate(lambda c, d, s: block_bore(c, whole=d >= 2)),
    "N21": _change_candidate(lambda c, d, s: add_debris(c, int(d), s.rng)),
    "N22": _change_candidate(lambda c, d, s: remove_sleepers(c, d / 100, s.rng)),
    "N23": _change_candidate(lambda c, d, s: respace_sleepers(c, d)),
    "N24": _change_candidate(lambda c, d, s: change_gauge(c, d)),
    "N25": _change_candidate(lambda c, d, s: scale_pockets(c, 0.0, d / 100, s.rng)),
    "N26": _change_candidate(_spoil_pockets),
    "N27": _change_candidate(lambda c, d, s: add_pillars(c, d)),
    "N28": _change_candidate(lambda c, d, s: close_mouth(c)),
    "N29": _change_candidate(lambda c, d, s: collide_whole_mesh(c, s.scratch)),
    "N30": _change_candidate(lambda c, d, s: move_panels(c, d, s.scratch)),
    "N31": _change_candidate(lambda c, d, s: widen_plan(c, d, s.scratch)),
    "N32": _spoil_poses,
    "N33": lambda case, d, s: judge_foreign(case, s.foreign()),
    "N34": _change_candidate(lambda c, d, s: null_tube(c, sleepers=d < 2)),
    "N35": _forge_recording,
    "N36": lambda case, d, s: leak_hold(case),
}
# Invariances: changes that must not move the scores.

SHIFT = np.array([1000.0, -640.0, 35.0])  # m
YAW = np.radians(30.0)
GLOBAL_LIMIT = 0.3
CATEGORY_LIMIT = 1.0
THINNED_LIMIT = 2.0


@dataclass(frozen=True)
class Invariance:
    """Control that must be quiet.

    Attributes:
        change: Change of the case.
        text: Change in words.
        category_limit: Points that a category may move.
        exempt: Categories that may move.
    """

    change: Callable[[Case, np.random.Generator], Case]
    text: str
    category_limit: float = CATEGORY_LIMIT
    exempt: tuple[str, ...] = ()


def _on_candidate(change: Callable[[Candidate, np.random.Generator], Candidate]) -> Callable[..., Case]:
    return lambda case, rng: replace(case, candidate=change(case.candidate, rng), cache={})


def _on_meshes(change: Callable[[trimesh.Trimesh], trimesh.Trimesh]) -> Callable[..., Candidate]:
    return lambda candidate, rng: replace(candidate, lining=change(candidate.lining), solid=change(candidate.solid))


def permute(candidate: Candidate, rng: np.random.Generator) -> Candidate:
    """Puts vertices and faces into another order."""

    def mixed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        order = rng.permutation(len(mesh.vertices))
        place = np.argsort(order)
        return trimesh.Trimesh(mesh.vertices[order], place[mesh.faces][rng.permutation(len(mesh.faces))], process=False)

    return replace(candidate, lining=mixed(candidate.lining), solid=mixed(candidate.solid))


def subdivide(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Cuts every face in four at the middles of its edges."""
    vertices, faces = trimesh.remesh.subdivide(mesh.vertices, mesh.faces)
    return trimesh.Trimesh(vertices, faces, process=False)


def move_together(case: Case, rng: np.random.Generator) -> Case:
    """Turns and shifts reconstruction and references alike."""
    turn = Rotation.from_euler("z", YAW).as_matrix()
    candidate = case.candidate

    def move(points: np.ndarray) -> np.ndarray:
        return points @ turn.T + SHIFT

    def mesh(old: trimesh.Trimesh) -> trimesh.Trimesh:
        return trimesh.Trimesh(move(old.vertices), old.faces, process=False) if len(old.faces) else old

    bore, track = candidate.bore, candidate.track
    turned = {name: getattr(bore, name) @ turn.T for name in ("tangent", "lateral", "up")}
    moved = replace(
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
    return replace(move_references(case, turn, SHIFT), candidate=moved)


def reverse_axis(case: Case, rng: np.random.Generator) -> Case:
    """Counts stations of the reconstruction from the other end."""
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


def exchange_formats(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Writes a mesh as OBJ and as binary STL and reads it again."""
    for kind in ("obj", "stl"):
        data = mesh.export(file_type=kind)
        assert isinstance(data, str | bytes)
        loaded = trimesh.load_mesh(trimesh.util.wrap_as_stream(data), file_type=kind, process=False)
        mesh = trimesh.Trimesh(loaded.vertices, loaded.faces, process=False)
        mesh.merge_vertices(digits_vertex=5)
    return mesh


def shuffle_beams(hold: Hold, rng: np.random.Generator) -> Hold:
    """Puts the beams of each scan into another order; scans stay in theirs."""
    order = np.lexsort((rng.random(len(hold.scan)), hold.scan))
    return take_beams(hold, order)


def thin_beams(hold: Hold, rng: np.random.Generator) -> Hold:
    """Keeps every second beam."""
    return take_beams(hold, np.flatnonzero(rng.random(len(hold.scan)) < 0.5))


def take_beams(hold: Hold, rows: np.ndarray) -> Hold:
    """Return some beams of a recording."""
    names = ("time", "scan", "origin", "direction", "range")
    return replace(hold, **{name: getattr(hold, name)[rows] for name in names}, cache={})


def _on_hold(change: Callable[[Hold, np.random.Generator], Hold]) -> Callable[..., Case]:
    return lambda case, rng: case if case.hold is None else replace(case, hold=change(case.hold, rng), cache={})


INVARIANCES: dict[str, Invariance] = {
    "I1": Invariance(_on_candidate(permute), "vertices and faces in another order"),
    "I2": Invariance(_on_candidate(_on_meshes(subdivide)), "every face in four", exempt=("TRI",)),
    "I3": Invariance(move_together, "everything 1 km away and turned by 30 degrees"),
    "I4": Invariance(reverse_axis, "chainage from the other end"),
    "I5": Invariance(_on_candidate(_on_meshes(exchange_formats)), "meshes through OBJ and STL"),
    "I6": Invariance(_on_hold(shuffle_beams), "beams of the held-out recording in another order"),
    "I7": Invariance(_on_hold(thin_beams), "half of the held-out beams", category_limit=THINNED_LIMIT),
}
