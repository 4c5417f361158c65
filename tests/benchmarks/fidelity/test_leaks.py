"""The leak detector finds what it is made for, and nothing in a clean split."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from benchmarks.fidelity import leaks
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.faults import Fault, Site, put_in
from benchmarks.fidelity.registry import Value
from scene.build import BuildConfig, build
from scene.survey.config import SurveyConfig
from scene.survey.simulate import simulate
from tests.benchmarks.fidelity import tube

GOOD = {"c2m_median": Value(0.012)}


@pytest.fixture(scope="module")
def case() -> Case:
    return tube.case(sigma=0.02, beams=40_000, spacing=4.0)  # dense, so that patches are flat


def test_a_clean_split_has_no_leak_nor_has_nothing_held_out(case: Case) -> None:
    other = tube.hold(tube.Tube(), sigma=0.02, beams=40_000, spacing=4.0, seed=1)
    assert leaks.find_leaks(replace(case, fit=other, cache={}), GOOD, case.hold.hash) == []
    assert leaks.find_leaks(replace(case, hold=None), {}) == []


def test_the_noise_of_the_recording_is_found(case: Case) -> None:
    sigma = leaks.plane_noise(case.hold, np.random.default_rng(0))
    assert 0.4 * 0.02 < sigma < 1.3 * 0.02  # a beam meets the wall aslant, so less of its noise is across the plane


def test_a_distance_below_half_of_the_noise_is_no_measurement(case: Case) -> None:
    for median, found in ((0.0025, 1), (0.012, 0)):
        assert len(leaks.noise_leaks(case, {"c2m_median": Value(median)})) == found


def test_shared_points_are_duplicates(case: Case) -> None:
    assert leaks.duplicate_share(case.hold, case.hold) == 1.0
    assert (
        leaks.duplicate_share(case.hold, tube.hold(tube.Tube(), sigma=0.02, beams=40_000, spacing=4.0, seed=1)) == 0.0
    )


def test_mesh_samples_without_noise_are_no_recording(case: Case) -> None:
    forged = put_in(Site(case), Fault("forged", 0.0))
    assert any("scatter" in found for found in leaks.find_leaks(forged, {"c2m_median": Value(0.0)}))


def test_mesh_samples_with_noise_are_told_by_their_provenance(case: Case) -> None:
    forged = put_in(Site(case), Fault("forged", 1.0))
    assert any("hash is another" in found for found in leaks.find_leaks(forged, GOOD, case.hold.hash))


def test_a_builder_that_read_the_held_out_recording_is_caught(case: Case) -> None:
    found = leaks.find_leaks(put_in(Site(case), Fault("leaked")), GOOD)
    assert any("builder read the held-out recording" in one for one in found)
    assert any("duplicates" in one for one in found)


@pytest.mark.slow
def test_the_builder_opens_only_its_own_recording(tmp_path: Path) -> None:
    simulate(SurveyConfig(out=tmp_path, length=24.0, sensors=("avia", "vlp16"), point_rate=60_000), Console())
    given = tmp_path / "groundtruth.tum"
    opened: set[Path] = set()
    sys.addaudithook(lambda event, names: opened.add(Path(str(names[0])).absolute()) if event == "open" else None)
    build(tmp_path / "survey.bag", tmp_path / "scene", given, BuildConfig())
    inside = {
        path.name for path in opened if path.is_relative_to(tmp_path) and not path.is_relative_to(tmp_path / "scene")
    }
    assert "groundtruth.tum" in inside
    assert not {"survey_vlp16.bag", "groundtruth_vlp16.tum", "truth.json", "truth.ply"} & inside
