"""Changes of a scene that move metrics: controls at a dose, local faults, and damage that no control does."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import trimesh

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.controls.catalogue import Setting, load_controls, spoil_case
from benchmarks.fidelity.controls.damage import copy_scene, double_faces
from benchmarks.fidelity.controls.local import Fault, make_ground, spoil
from benchmarks.fidelity.controls.shape import axis_of, keep_bodies, without_faces
from benchmarks.fidelity.impostors import null_tube


def _lose_a_vertex(candidate: Candidate, scratch: Path) -> Candidate:
    vertices = candidate.lining.vertices.copy()
    vertices[5, 1] = np.nan
    return replace(candidate, lining=trimesh.Trimesh(vertices, candidate.lining.faces, process=False))


def _swell_the_solid(candidate: Candidate, scratch: Path) -> Candidate:
    solid = candidate.solid.copy()
    solid.apply_scale(1.02)
    return replace(candidate, solid=solid)


def _flatten_a_face(candidate: Candidate, scratch: Path) -> Candidate:
    def flat(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        corner = mesh.faces[::500, :2]
        return trimesh.Trimesh(mesh.vertices, np.vstack([mesh.faces, corner[:, [0, 0, 1]]]), process=False)

    return replace(candidate, lining=flat(candidate.lining), solid=flat(candidate.solid))


def _add_slivers(candidate: Candidate, scratch: Path) -> Candidate:
    """Adds as many slivers as a fifth of the faces."""
    return double_faces(candidate, 0.2, np.random.default_rng(0))


def _span_the_bend(candidate: Candidate, scratch: Path) -> Candidate:
    """Adds a face from one mouth to the other."""
    station = axis_of(candidate).local(np.asarray(candidate.lining.vertices))[:, 0]
    first, last = int(np.argmin(station)), int(np.argmax(station))
    faces = np.vstack([candidate.lining.faces, [first, first + 1, last]])
    return replace(candidate, lining=trimesh.Trimesh(candidate.lining.vertices, faces, process=False))


def _cut_the_rails(candidate: Candidate, scratch: Path) -> Candidate:
    """Takes out of the rails what lies between stations 10 and 11 m; they are cut into short boxes first."""
    cut = make_ground(candidate).candidate
    mesh = cut.track.rail_mesh
    station = axis_of(candidate).local(np.asarray(mesh.triangles_center))[:, 0]
    rails = without_faces(mesh, (station > 10.0) & (station < 11.0))
    return replace(cut, track=replace(cut.track, rail_mesh=rails))


def _lose_fastenings(candidate: Candidate, scratch: Path) -> Candidate:
    line = axis_of(candidate)
    fastening = keep_bodies(candidate.track.fastening_mesh, lambda middle: line.local(middle)[:, 0] > 6.0)
    return replace(candidate, track=replace(candidate.track, fastening_mesh=fastening))


def _space_unevenly(candidate: Candidate, scratch: Path) -> Candidate:
    track, line = candidate.track, axis_of(candidate)
    local = line.local(track.sleeper)
    local[np.argsort(local[:, 0])[::2], 0] += 0.05
    return replace(candidate, track=replace(track, sleeper=line.point(local)))


def _local(kind: str, size: float, start: float = 12.0, length: float = 10.0) -> Callable[[Candidate, Path], Candidate]:
    return lambda candidate, scratch: spoil(make_ground(candidate), Fault(kind, start, length, size))


def _edit(change: Callable[[ElementTree.Element], None]) -> Callable[[Candidate, Path], Candidate]:
    """Changes the text of the scene in a copy of its folder."""

    def edited(candidate: Candidate, scratch: Path) -> Candidate:
        copy = copy_scene(candidate, scratch)
        root = ElementTree.fromstring(copy.scene.read_text())
        change(root)
        copy.scene.write_text(ElementTree.tostring(root, encoding="unicode"))
        return copy

    return edited


def _set(path: str, **attributes: str) -> Callable[[Candidate, Path], Candidate]:
    """Sets attributes of every element that a path finds."""

    def change(root: ElementTree.Element) -> None:
        found = root.findall(path)
        assert found, path
        for element in found:
            element.attrib |= attributes

    return _edit(change)


def _move(path: str, by: tuple[float, float, float]) -> Callable[[Candidate, Path], Candidate]:
    """Moves every element that a path finds, m."""

    def change(root: ElementTree.Element) -> None:
        found = root.findall(path)
        assert found, path
        for element in found:
            place = np.fromstring(element.get("pos", "0 0 0"), sep=" ") + by
            element.set("pos", " ".join(f"{value:.9g}" for value in place))

    return _edit(change)


def _stiffen(root: ElementTree.Element) -> None:
    for geom in root.findall("./worldbody/body/geom"):
        geom.attrib |= {"solref": "-1000000000 0", "solimp": "0.99 0.999 0.001"}
    for option in root.findall("./option"):
        option.attrib |= {"integrator": "Euler", "timestep": "0.1"}


OWN: dict[str, Callable[[Candidate, Path], Candidate]] = {
    "a vertex that is no number": _lose_a_vertex,
    "solid 2 % larger than the sections": _swell_the_solid,
    "faces without area": _flatten_a_face,
    "slivers": _add_slivers,
    "a face from mouth to mouth": _span_the_bend,
    "rails cut for 1 m": _cut_the_rails,
    "fastenings of 6 m missing": _lose_fastenings,
    "everything 15 cm up over 10 m": _local("lift", 0.15),
    "track 2 m aside over 10 m": _local("track", 2.0),
    "every second sleeper 5 cm along": _space_unevenly,
    "rails 3 cm up over 10 m": _local("rails", 0.03),
    "tube without track": lambda candidate, scratch: null_tube(candidate, sleepers=False),
    "two geoms of one name": _set(".//geom[@name='sleeper_0003']", name="sleeper_0004"),
    "lining of the scene 5 cm aside": _move(".//geom[@name='lining_000']", (0.0, 0.05, 0.0)),
    "sleeper missing from the scene": _set(".//geom[@name='sleeper_0003']", name="plank"),
    "scene 1000 km away": _move("./worldbody/*", (1e6, 0.0, 0.0)),
    "contacts too stiff for the time step": _edit(_stiffen),
    "robot of a shape that MJX refuses": _set("./worldbody/body/geom", type="ellipsoid", size="0.3 0.2 0.3"),
}


def spoil_by(case: Case, change: str, scratch: Path) -> Case:
    """Return the case with a change by its name: an entry of `OWN`, or `Nxx-dose` of the controls."""
    if change in OWN:
        return replace(case, candidate=OWN[change](case.candidate, scratch), cache={})
    control, dose = change.split("-")
    assert control in load_controls()
    setting = Setting(np.random.default_rng(0), scratch, lambda: case.candidate)
    return spoil_case(case, control, float(dose), setting)
