"""Control and odometry on a whole simulated survey, by the user's own commands."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from scene.build import reconstruct
from scene.config import ReconstructConfig
from scene.errors import RecordingError
from scene.progress import Stages
from tests.scene.bags import write_bag, write_tum

ROOT = Path(__file__).parents[2]


def run(*arguments: object) -> None:
    done = subprocess.run([sys.executable, "-m", *map(str, arguments)], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture
def bag(tmp_path):
    rng = np.random.default_rng(0)
    return write_bag(tmp_path / "a.bag", [(100.0 + 0.1 * k, rng.uniform(-3, 3, (200, 3))) for k in range(5)])


def control_rows(start: float) -> np.ndarray:
    times = start + 0.3 * np.arange(40)
    return np.column_stack([times, times - start, np.zeros((40, 6))])


def test_control_of_another_day_is_refused_before_any_odometry(bag, tmp_path):

    control = write_tum(tmp_path / "prism.tum", control_rows(0.0))
    with pytest.raises(RecordingError, match=r"prism\.tum: control runs from 0\.00 to 11\.70 s, but .*a\.bag from 100"):
        reconstruct(bag, None, ReconstructConfig(), Stages(), control)


def test_control_and_a_trajectory_together_are_refused(bag, tmp_path):

    control = write_tum(tmp_path / "prism.tum", control_rows(100.0))
    with pytest.raises(RecordingError, match=r"prism\.tum: control is for a recording without a trajectory"):
        reconstruct(bag, control, ReconstructConfig(), Stages(), control)


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    out = tmp_path_factory.mktemp("survey")
    run("scene.survey", "--length", 30, "--seed", 77, "--out", out)
    return out


@pytest.mark.slow
def test_prism_control_gives_the_bore_in_the_surveys_own_frame(survey, tmp_path):
    from benchmarks.truth import compare, load_truth

    bag, prism = survey / "survey.bag", survey / "prism.tum"
    run("scene.build", bag, "--control", prism, "--calibration", "geode-gamma", "--out", tmp_path / "scene")
    comparison = compare(tmp_path / "scene", load_truth(survey / "truth.json"))
    assert abs(comparison.length_error) < 0.002 * 30 + 0.01
    assert np.sqrt(np.mean(comparison.lateral**2)) < 0.05
    assert np.sqrt(np.mean(comparison.width**2)) < 0.04
    assert np.sqrt(np.mean(comparison.height**2)) < 0.04
    found = json.loads((tmp_path / "scene" / "manifest.json").read_text())["detected"]
    assert found["length_fixed_by"] == "control"
    assert found["imu"] == "/livox/imu"
    assert abs(comparison.length_error) < found["length_uncertainty"] < 0.2


@pytest.mark.slow
def test_odometry_alone_says_that_nobody_measured_the_length(survey, tmp_path):
    run("scene.build", survey / "survey.bag", "--out", tmp_path / "scene")
    found = json.loads((tmp_path / "scene" / "manifest.json").read_text())["detected"]
    assert "nothing measured the axial scale" in found["length_fixed_by"]
    assert found["length_uncertainty"] is None
