"""Nothing in the score is true by construction: for each scored metric a fault moves its value and its score.

Faults that no control does are registered here, as a user's own file would. The slow test puts all of them into a
survey made anew.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh

from benchmarks.fidelity import scoring, table
from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.faults import Fault, Site, fault_kind, put_in
from benchmarks.fidelity.faults.kinds import load_controls, local_site
from benchmarks.fidelity.faults.mesh import change_both, copy_scene
from benchmarks.fidelity.inputs import Inputs, complete_inputs, make, read_case
from benchmarks.fidelity.meshes import keep_bodies, without_faces
from tests.benchmarks.fidelity.judged import measure

LEAST = 5.0  # points that the fault must cost the metric
SEED = 411


@fault_kind("unfinite", "a vertex that is no number")
def lose_a_vertex(site: Site, fault: Fault) -> Candidate:
    vertices = site.candidate.lining.vertices.copy()
    vertices[5, 1] = np.nan
    return replace(site.candidate, lining=trimesh.Trimesh(vertices, site.candidate.lining.faces, process=False))


@fault_kind("swollen", "solid 2 % larger than the sections")
def swell_the_solid(site: Site, fault: Fault) -> Candidate:
    solid = site.candidate.solid.copy()
    solid.apply_scale(1.02)
    return replace(site.candidate, solid=solid)


@fault_kind("flattened", "faces without area")
def flatten_a_face(site: Site, fault: Fault) -> Candidate:
    def flat(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        corner = mesh.faces[::500, :2]
        return trimesh.Trimesh(mesh.vertices, np.vstack([mesh.faces, corner[:, [0, 0, 1]]]), process=False)

    return change_both(site.candidate, flat)


@fault_kind("spanned", "a face from one mouth to the other")
def span_the_bend(site: Site, fault: Fault) -> Candidate:
    lining = site.candidate.lining
    station = site.line.local(np.asarray(lining.vertices))[:, 0]
    first, last = int(np.argmin(station)), int(np.argmax(station))
    faces = np.vstack([lining.faces, [first, first + 1, last]])
    return replace(site.candidate, lining=trimesh.Trimesh(lining.vertices, faces, process=False))


@fault_kind("cut rails", "rails missing from station 10 to 11 m")
def cut_the_rails(site: Site, fault: Fault) -> Candidate:
    cut = local_site(site.case).candidate
    mesh = cut.track.rail_mesh
    station = site.line.local(np.asarray(mesh.triangles_center))[:, 0]
    return replace(cut, track=replace(cut.track, rail_mesh=without_faces(mesh, (station > 10.0) & (station < 11.0))))


@fault_kind("lost fastenings", "fastenings of 6 m missing")
def lose_fastenings(site: Site, fault: Fault) -> Candidate:
    track = site.candidate.track
    left = keep_bodies(track.fastening_mesh, lambda middle: site.line.local(middle)[:, 0] > 6.0)
    return replace(site.candidate, track=replace(track, fastening_mesh=left))


@fault_kind("uneven sleepers", "every second sleeper 5 cm along")
def space_unevenly(site: Site, fault: Fault) -> Candidate:
    track = site.candidate.track
    local = site.line.local(track.sleeper)
    local[np.argsort(local[:, 0])[::2], 0] += 0.05
    return replace(site.candidate, track=replace(track, sleeper=site.line.point(local)))


def edit(name: str, path: str, change: Callable[[ElementTree.Element], None]) -> None:
    """Registers a fault that changes every element of the scene's file that a path finds, in a copy of its folder."""

    @fault_kind(name, name)
    def edited(site: Site, fault: Fault) -> Candidate:
        copy = copy_scene(site.candidate, site.scratch)
        root = ElementTree.fromstring(copy.scene.read_text())
        assert root.findall(path), path
        for element in root.findall(path):
            change(element)
        copy.scene.write_text(ElementTree.tostring(root, encoding="unicode"))
        return copy


def put(**attributes: str) -> Callable[[ElementTree.Element], None]:
    return lambda element: element.attrib.update(attributes)


def move(*by: float) -> Callable[[ElementTree.Element], None]:
    def moved(element: ElementTree.Element) -> None:
        place = np.fromstring(element.get("pos", "0 0 0"), sep=" ") + by
        element.set("pos", " ".join(f"{value:.9g}" for value in place))

    return moved


def stiffen(root: ElementTree.Element) -> None:
    for geom in root.findall("./worldbody/body/geom"):
        geom.attrib |= {"solref": "-1000000000 0", "solimp": "0.99 0.999 0.001"}
    for option in root.findall("./option"):
        option.attrib |= {"integrator": "Euler", "timestep": "0.1"}


edit("same names", ".//geom[@name='sleeper_0003']", put(name="sleeper_0004"))
edit("moved lining", ".//geom[@name='lining_000']", move(0.0, 0.05, 0.0))
edit("lost sleeper", ".//geom[@name='sleeper_0003']", put(name="plank"))
edit("far scene", "./worldbody/*", move(1e6, 0.0, 0.0))
edit("stiff contacts", ".", stiffen)
edit("ellipsoid", "./worldbody/body/geom", put(type="ellipsoid", size="0.3 0.2 0.3"))


def fault_of(text: str) -> Fault:
    """A fault of the table: `control; ID; DOSE` or `fault; KIND; SIZE; STATION; EXTENT`."""
    kind, name, *numbers = text.split("; ")
    return load_controls()[name].faults[float(numbers[0])] if kind == "control" else Fault(name, *map(float, numbers))


ROWS = [row.split(" => ") for row in Path(__file__).with_name("moves.txt").read_text().splitlines() if row[0] != "#"]
MOVES = {fault_of(fault): ids for fault, ids in ROWS}


def test_every_scored_metric_has_a_fault_that_moves_it() -> None:
    counted = Counter(id for ids in MOVES.values() for id in ids.split())
    assert counted == Counter(id for id, row in table.load().items() if row.scored)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_on_a_survey_made_anew_every_fault_moves_its_metrics(tmp_path: Path) -> None:
    case = make_case(tmp_path)
    before = {id: measure(id, case) for ids in MOVES.values() for id in ids.split()}
    case.cache.clear()
    rows = table.load()
    full = [scoring.score_one(rows[id], value).score == 100.0 for id, value in before.items()]
    assert sum(full) < 0.7 * len(full)  # the scale is not used up by a good reconstruction
    still = []
    for number, (fault, ids) in enumerate(MOVES.items()):
        corrupted = put_in(Site(case, scratch=tmp_path / str(number)), fault)
        for id in ids.split():
            after = measure(id, corrupted)
            cost = scoring.score_one(rows[id], before[id]).score - scoring.score_one(rows[id], after).score
            if before[id].value == after.value or cost < LEAST:
                still.append((id, fault, before[id].value, after.value, cost))
        corrupted.cache.clear()
    assert still == []


def make_case(folder: Path) -> Case:
    """Simulates a 36 m survey, builds its scene from the Avia, and judges it by the OS1."""
    survey, scene = folder / "survey", folder / "scene"
    make("scene.survey", "--truth", "metro", "--length", 36, "--seed", SEED, "--tolerances",
               "--sensors", "avia", "os1", "--scan-every", 6, "--out", survey)  # fmt: skip
    make("scene.build", survey / "survey.bag", "--trajectory", survey / "groundtruth.tum",
               "--provenance", "simulated", "--out", scene)  # fmt: skip
    return read_case(complete_inputs(Inputs(
        scene=scene, recording=survey / "survey_os1.bag", trajectory=survey / "groundtruth_os1.tum", truth=survey,
        fit_recording=survey / "survey.bag", fit_trajectory=survey / "groundtruth.tum",
    )))  # fmt: skip
