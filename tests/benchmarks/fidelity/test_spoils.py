"""Every control does to the geometry what its row says."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from benchmarks.fidelity.candidate import Candidate, load_candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.scene import scene_model
from benchmarks.fidelity.derive.surface import visible_mesh
from benchmarks.fidelity.faults import KINDS, Fault, Site, put_in
from benchmarks.fidelity.faults.kinds import MESHES, TRACK, load_controls, local_site
from subterra_jax.host.tunnelfile import read_fields
from tests.benchmarks.fidelity import tube, tubescene
from tests.benchmarks.fidelity.test_tubes import about, value_of
from tests.recorded import arrays_of, check, figures

VALUES = Path(__file__).with_name("faults.csv")

IN_SCENE = ("N01", "N12", "N29", "N30", "N31")
DOSES = [  # the bold ones, and the last of each kind
    (id, dose) for id, one in load_controls().items() if id not in IN_SCENE
    for dose, fault in one.faults.items()
    if dose in one.bold or dose == [d for d, other in one.faults.items() if other.kind == fault.kind][-1]
]  # fmt: skip
LOCAL = {"missing": 0.5, "pockets": 0.4} | dict.fromkeys(
    ("wall", "roof", "floor", "aside", "lift", "rails", "track", "along", "roll", "box", "gauge", "section", "width",
     "sleepers"), 0.04
)  # fmt: skip


def contents(case: Case) -> dict[str, Any]:
    """Geometry and recording of a case by name."""
    one, heard = case.candidate, case.hold
    meshes = {name: getattr(one, name) for name in MESHES} | {name: getattr(one.track, name) for name in TRACK}
    beams = {name: getattr(heard, name) for name in ("range", "origin", "direction", "time")}
    bore = {f"bore {name}": value for name, value in vars(one.bore).items()}
    shapes = {name: {"vertices": mesh.vertices, "faces": mesh.faces} for name, mesh in meshes.items()}
    return {**shapes, **bore, **beams, "rail": one.track.rail, "sleeper": one.track.sleeper}


def changes(before: Case, after: Case) -> dict[str, Any]:
    """Things added to the contents of a case; all that is new where there is more or less of it."""
    old, new = contents(before), contents(after)
    return {name: _apart(value, old[name]) for name, value in new.items()
            if list(figures(value)) != list(figures(old[name]))}  # fmt: skip


def _apart(new: Any, old: Any) -> Any:
    if isinstance(new, dict):
        return {name: _apart(value, old[name]) for name, value in new.items()}
    alike = np.shape(new) == np.shape(old) and np.asarray(new).dtype.names is None
    return np.asarray(new, float) - old if alike else new


@pytest.fixture(scope="module")
def base() -> Case:
    return tube.case()


def corrupt(case: Case, control: str, dose: float, scratch: Path = Path("unused")) -> Case:
    other = tube.Tube(heading=1.0, bend=70.0)
    site = Site(case, scratch=scratch, foreign=lambda: tube.candidate(other))
    return put_in(site, load_controls()[control].faults[dose])


def candidate(case: Case, control: str, dose: float) -> Candidate:
    return corrupt(case, control, dose).candidate


def test_the_table_has_36_controls_and_7_invariances_and_each_has_a_function() -> None:
    assert list(load_controls()) == [f"N{k:02d}" for k in range(1, 37)] + [f"I{k}" for k in range(1, 8)]
    for control in load_controls().values():
        assert set(control.bold) <= set(control.faults)
        assert control.bold
        assert {fault.kind for fault in control.faults.values()} <= set(KINDS)
        assert (control.kind == "invariance") == (control.limit is not None)
        assert control.falls or control.limit or "leak" in control.reason


@pytest.mark.parametrize(("control", "dose"), DOSES)
def test_a_control_changes_something_and_leaves_the_base_alone(base: Case, control: str, dose: float) -> None:
    before = base.candidate.lining.vertices.copy(), base.candidate.solid.faces.copy(), base.hold.origin.copy()
    corrupted = corrupt(base, control, dose)
    np.testing.assert_array_equal(before[0], base.candidate.lining.vertices)
    np.testing.assert_array_equal(before[1], base.candidate.solid.faces)
    np.testing.assert_array_equal(before[2], base.hold.origin)
    assert corrupted.candidate is not base.candidate or corrupted.hold is not base.hold
    assert not corrupted.cache
    check(VALUES, f"{control} {list(load_controls()[control].faults).index(dose)}", changes(base, corrupted))
    again = corrupt(base, control, dose)  # the same bytes
    np.testing.assert_array_equal(corrupted.candidate.lining.vertices, again.candidate.lining.vertices)
    np.testing.assert_array_equal(corrupted.hold.range, again.hold.range)


@pytest.mark.parametrize("kind", LOCAL)
def test_a_local_fault_changes_what_it_changed(base: Case, kind: str) -> None:
    site = local_site(base)
    check(VALUES, kind, changes(site.case, put_in(site, Fault(kind, LOCAL[kind], 6.0, 2.0, 0.5))))


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Case:
    return Case(load_candidate(tubescene.write(tmp_path_factory.mktemp("scene") / "tube", tube.Tube(length=12.0))))


SCENES = {  # control, and what holds of the scene that it leaves
    "N01": {
        "mj_frame_err": about(0, 1e-3),
        "mj_ray_vs_mesh_mae": about(0, 1e-3),
        "mj_wall_contact_err": about(0, 0.01),
    },
    "N12": {"mj_frame_err": about(0, 1.0), "mj_ray_leak_rate": about(0.0475, 0.005)},
    "N29": {"mj_probe_free_frac": about(0), "mj_ray_vs_mesh_mae": about(0, 1e-3)},
    "N30": {"mj_wall_contact_err": about(0.10, 0.01), "mj_probe_free_frac": about(1)},
    "N31": {"mj_wall_contact_err": about(0, 0.01)},
}


@pytest.mark.parametrize("control", SCENES)
def test_a_control_of_the_scene_changes_what_it_says(scene: Case, tmp_path: Path, control: str) -> None:
    dose = load_controls()[control].bold[-1]
    after = corrupt(scene, control, dose, tmp_path)
    known = {id: (value_of(id, after), low, high) for id, (low, high) in SCENES[control].items()}
    assert {id: one for id, one in known.items() if not one[1] <= one[0] <= one[2]} == {}
    model, plan = arrays_of(scene_model(after)), read_fields(after.candidate.tunnel)
    shown = {"lining": after.candidate.lining.vertices, "faces": after.candidate.lining.faces}
    check(VALUES, f"{control} scene", {"model": model, "plan": plan, **shown})
    if control == "N31":
        apart = [plan["left_smooth"] - plan["right_smooth"], plan["left_pockets"] - plan["right_pockets"]]
        before = read_fields(scene.candidate.tunnel)
        wide = np.linalg.norm(before["left_smooth"] - before["right_smooth"], axis=1) + dose
        np.testing.assert_allclose(np.linalg.norm(apart, axis=2), [wide, wide], atol=1e-3)


def test_an_axial_stretch_moves_mesh_and_recording_together(base: Case) -> None:
    corrupted = corrupt(base, "N04", 5)
    assert corrupted.candidate.length == pytest.approx(1.05 * base.candidate.length, rel=1e-3)
    near = trimesh.proximity.closest_point(corrupted.candidate.lining, corrupted.hold.points[::400])[1]
    before = trimesh.proximity.closest_point(base.candidate.lining, base.hold.points[::400])[1]
    assert np.median(near) < 1.5 * np.median(before)


def test_a_hole_has_its_area(base: Case) -> None:
    lost = base.candidate.lining.area - candidate(base, "N13", 1.0).lining.area
    assert lost == pytest.approx(1.0, abs=0.15)


def test_removed_pockets_leave_a_smooth_wall_of_less_volume_half_a_millimetre_deep(base: Case) -> None:
    corrupted, pocket = candidate(base, "N25", 100), base.candidate.bore.pocket
    taken = base.candidate.solid.volume - corrupted.solid.volume
    assert taken == pytest.approx(float((pocket["length"] * pocket["width"] * pocket["depth"]).sum()), rel=0.35)
    assert len(corrupted.bore.pocket) == 0
    moved = np.linalg.norm(corrupted.lining.vertices - base.candidate.lining.vertices, axis=1) > 0.05
    local = Site(base).line.local(corrupted.lining.vertices[moved])
    left = np.hypot(local[:, 1], local[:, 2]) - tube.Tube().scale(local[:, 0]) * tube.Tube().section.radius(
        np.arctan2(local[:, 2], local[:, 1]))  # fmt: skip
    assert np.median(left) == pytest.approx(5e-4, abs=2e-4)


def test_what_a_control_counts_is_as_dense_in_a_long_tunnel() -> None:
    """The points that it must cost were set on 36 m; one wall in ten times that would count a tenth."""
    straight = {"bend": np.inf, "depth": 0.0, "track": False}
    for length, walls in ((36.0, 1), (108.0, 3)):
        case = tube.case(tube.Tube(length=length, **straight), beams=60)
        assert len(candidate(case, "N21", 5).extra.split()) == 5 * walls
        assert len(candidate(case, "N20", 1).extra.split()) == walls


def test_a_closed_mouth_has_one_rim_less(base: Case) -> None:
    def rims(mesh: trimesh.Trimesh) -> int:
        edges, count = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
        return len(trimesh.graph.connected_components(edges[count == 1], min_len=3))

    open_mesh = base.candidate.lining.copy()
    open_mesh.merge_vertices(digits_vertex=6)
    assert rims(candidate(base, "N28", 1).lining) == rims(open_mesh) - 1


def test_permuted_poses_keep_every_beam(base: Case) -> None:
    corrupted = corrupt(base, "N32", 2).hold
    np.testing.assert_array_equal(corrupted.range, base.hold.range)
    assert np.median(np.linalg.norm(corrupted.origin - base.hold.origin, axis=1)) > 1.0


def test_a_foreign_tunnel_is_brought_to_our_mouth(base: Case) -> None:
    other = tube.candidate(tube.Tube(heading=1.0, bend=70.0))
    corrupted = corrupt(base, "N33", 1.0)
    assert corrupted.truth.position[0] == pytest.approx(other.bore.position[0], abs=0.2)
    flat = corrupted.truth.tangent[0, :2] @ other.bore.tangent[0, :2]
    assert flat == pytest.approx(1.0, abs=2e-3)


def test_nails_are_seen_move_with_the_pattern_and_go_with_their_pockets(base: Case) -> None:
    bore = base.candidate.bore
    one = bore.pocket[len(bore.pocket) // 2]
    row = int(np.argmin(np.abs(bore.station - one["station"])))
    away = np.cos(one["angle"]) * bore.lateral[row] + np.sin(one["angle"]) * bore.up[row]
    nail = trimesh.creation.icosphere(subdivisions=0, radius=0.02)
    nail.apply_translation(bore.position[row] + 2.7 * away)
    nailed = tube.corrupted(base, nails=nail)
    assert len(visible_mesh(nailed.candidate).faces) == len(visible_mesh(base.candidate).faces) + len(nail.faces)
    assert not len(candidate(nailed, "N25", 100).nails.faces)
    assert len(candidate(nailed, "N26", 2).nails.faces) == len(nail.faces)
    along = (candidate(nailed, "N26", 3).nails.centroid - nail.centroid) @ bore.tangent[row]
    assert abs(along) > 0.2


def test_a_mesh_keeps_corners_a_millimetre_apart_on_its_way_through_other_formats(base: Case) -> None:
    small = replace(base.candidate, lining=trimesh.creation.box((1e-3, 1e-3, 1e-3)))
    sent = put_in(Site(replace(base, candidate=small, cache={})), Fault("exchanged"))
    assert len(sent.candidate.lining.vertices) == 8
