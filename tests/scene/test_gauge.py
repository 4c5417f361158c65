"""The gauge by single returns: within a millimetre and a half of the truth, and left alone where they are blurred."""

import json

import numpy as np
import pytest
from rich.console import Console

from scene.build import reconstruct
from scene.config import ReconstructConfig
from scene.fitting.rails import measure_again
from scene.fitting.trackseen import above_floor, find_track
from scene.progress import Stages
from scene.reconstruction import Reconstruction
from scene.survey.config import SurveyConfig
from scene.survey.simulate import simulate


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Reconstruction, float]:
    folder = tmp_path_factory.mktemp("survey")
    simulate(
        SurveyConfig(folder, truth="metro", length=19.0, seed=601, tolerances=True, speed=2.0), Console(quiet=True)
    )
    with Stages(Console(quiet=True)) as progress:
        found = reconstruct(folder / "survey.bag", folder / "groundtruth.tum", ReconstructConfig(), progress)
    return found, json.loads((folder / "truth.json").read_text())["rails"]["gauge"]


def test_single_returns_show_a_gauge_that_means_of_voxels_widen(built):
    found, gauge = built
    (line,) = found.seen.lines
    assert line.rails.measured
    assert line.rails.gauge == pytest.approx(gauge, abs=0.0015)
    (thinned,) = find_track(found.cloud, found.bore).lines
    assert thinned.rails.gauge > gauge + 0.0015
    np.testing.assert_array_equal(line.rails.offset, thinned.rails.offset)
    assert line.rails.top == thinned.rails.top


def test_few_or_blurred_returns_leave_the_gauge_as_it_was(built):
    found, _ = built
    rails = found.seen.lines[0].rails
    station, lateral, upward, height = above_floor(found.cloud.points.astype(np.float64), found.bore)
    again = measure_again(rails, station, lateral, height, upward)
    assert again.gauge != rails.gauge
    blurred = lateral + np.random.default_rng(1).normal(0.0, 0.012, len(lateral))
    assert measure_again(rails, station, blurred, height, upward) is rails
    assert measure_again(rails, station[:5], lateral[:5], height[:5], upward[:5]) is rails
