"""A slab above the invert of a round bore is ground that sensors and robots meet."""

import numpy as np
import pytest

from benchmarks.fidelity.candidate import load_candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.surface import visible_mesh
from benchmarks.fidelity.faults import Fault, Site, put_in
from benchmarks.fidelity.impostors import null_tube
from tests.benchmarks.fidelity import tubescene
from tests.benchmarks.fidelity.tube import Tube

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


def test_a_bed_that_the_scene_shows_is_seen(scene) -> None:
    judged = with_slab(scene, 0)
    np.testing.assert_allclose(judged.bed.bounds, [[1, -1.5, -2.1], [5, 1.5, -1.9]], atol=1e-6)
    assert len(visible_mesh(judged).faces) == len(visible_mesh(load_candidate(scene)).faces) + 12
    assert len(null_tube(judged).bed.faces) == 12
    assert not len(null_tube(judged, sleepers=False).bed.faces)


def test_a_bed_that_only_bodies_touch_is_not(scene) -> None:
    assert not len(with_slab(scene, 3).bed.faces)


def test_the_bed_moves_with_everything_else(scene) -> None:
    judged = with_slab(scene, 0)
    moved = put_in(Site(Case(judged)), Fault("elsewhere")).candidate
    apart = [part.bed.centroid - part.lining.centroid for part in (judged, moved)]
    assert np.linalg.norm(apart[0]) == pytest.approx(np.linalg.norm(apart[1]), abs=1e-6)
    assert np.linalg.norm(moved.bed.centroid - judged.bed.centroid) > 1000.0
