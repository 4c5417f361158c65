"""The truth as candidate, its bed, and changes that must not matter."""

import numpy as np
import pytest

from benchmarks.fidelity import table
from benchmarks.fidelity.candidate import load_candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.surface import visible_mesh
from benchmarks.fidelity.faults import Fault, Site, put_in
from benchmarks.fidelity.faults.kinds import load_controls
from benchmarks.fidelity.impostors import null_tube, truth_candidate
from tests.benchmarks.fidelity import tube, tubescene
from tests.benchmarks.fidelity.judged import measure, raw
from tests.benchmarks.fidelity.tube import Tube


@pytest.fixture(scope="module")
def case() -> Case:
    return tube.case(tube.Tube(variation=0.04, bend=90.0))


def score(case: Case, id: str) -> float:
    return table.load()[id].map.score(measure(id, case).value or 0.0)


def judged(case: Case, candidate: object) -> Case:
    return Case(candidate, case.hold, None, case.truth)  # type: ignore[arg-type]


def test_the_null_tube_is_one_section_along_the_right_axis(case: Case) -> None:
    null = null_tube(case.candidate)
    np.testing.assert_array_equal(null.bore.position, case.candidate.bore.position)
    assert np.ptp(null.bore.width) == 0.0
    assert null.solid.is_volume
    angle = case.candidate.bore.angle
    area = 0.5 * np.trapezoid(null.bore.radius[0] ** 2, angle)
    assert null.solid.volume == pytest.approx(area * null.length, rel=0.02)
    assert len(null.bore.pocket) == 0


def test_the_null_tube_knows_nothing_of_pockets_and_variation(case: Case) -> None:
    null = judged(case, null_tube(case.candidate))
    for id in ("sec_variation_ratio", "sec_variation_corr", "lin_pocket_f1", "lin_depth_map_ncc"):
        assert score(null, id) < 20.0 < score(case, id), id


def test_the_truth_as_candidate_is_the_truth(case: Case) -> None:
    assert case.truth is not None
    made = truth_candidate(case.truth, case.candidate)
    assert made.solid.is_watertight
    assert made.solid.volume == pytest.approx(case.candidate.solid.volume, rel=1e-3)
    known = np.isfinite(made.bore.radius).all()
    assert known
    for id in ("sec_iou_mean", "sec_width_rmse", "cl_lateral_rmse"):
        assert score(judged(case, made), id) == 100.0, id
    assert (
        raw("c2m_mean", judged(case, made)) < 0.0125
    )  # of this tube's own recording; the noise floor is that of another sensor


SLAB = '<geom name="bed_000" type="box" size="2 1.5 0.1" pos="3 0 -2" contype="5" conaffinity="0" group="{group}"/>'


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tubescene.write(tmp_path_factory.mktemp("bed") / "tube", Tube(length=6.0))


def with_slab(scene, group: int):
    path = scene / "scene.xml"
    text = path.read_text()
    path.write_text(text.replace("</worldbody>", SLAB.format(group=group) + "</worldbody>"))
    try:
        return load_candidate(scene)
    finally:
        path.write_text(text)


def test_a_bed_that_the_scene_shows_is_seen_and_one_that_only_bodies_touch_is_not(scene) -> None:
    judged = with_slab(scene, 0)
    np.testing.assert_allclose(judged.bed.bounds, [[1, -1.5, -2.1], [5, 1.5, -1.9]], atol=1e-6)
    assert len(visible_mesh(judged).faces) == len(visible_mesh(load_candidate(scene)).faces) + 12
    assert len(null_tube(judged).bed.faces) == 12
    assert not len(null_tube(judged, sleepers=False).bed.faces)
    assert not len(with_slab(scene, 3).bed.faces)


def test_the_bed_moves_with_everything_else(scene) -> None:
    judged = with_slab(scene, 0)
    moved = put_in(Site(Case(judged)), Fault("elsewhere")).candidate
    apart = [part.bed.centroid - part.lining.centroid for part in (judged, moved)]
    assert np.linalg.norm(apart[0]) == pytest.approx(np.linalg.norm(apart[1]), abs=1e-6)
    assert np.linalg.norm(moved.bed.centroid - judged.bed.centroid) > 1000.0


WATCHED = ("c2m_mean", "beam_range_mae", "cl_lateral_rmse", "sec_width_rmse", "mesh_orientation_frac", "trk_sleeper_f1")


@pytest.fixture(scope="module")
def base() -> Case:
    return tube.case(tube.Tube(bend=80.0))


INVARIANCES = {id: control for id, control in load_controls().items() if control.kind == "invariance"}


def changed(base: Case, control: str) -> Case:
    return put_in(Site(base), INVARIANCES[control].faults[0.0])


@pytest.mark.parametrize("control", INVARIANCES)
def test_an_invariance_is_quiet(base: Case, control: str) -> None:
    for id in WATCHED:
        assert score(changed(base, control), id) == pytest.approx(score(base, id), abs=INVARIANCES[control].limit)
