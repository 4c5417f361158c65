"""Control and odometry on a whole simulated survey, by the user's own commands."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]


def run(*arguments: object) -> None:
    done = subprocess.run([sys.executable, "-m", *map(str, arguments)], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


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
