"""A simulated survey through the builder, against the survey's own truth. Neither knows the other's code."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.truth import compare, load_truth
from scene.geometry import make_axis

ROOT = Path(__file__).parents[1]
LENGTH, SEED = 24, 11  # a seed that the builder was not developed on


def run(*arguments: object) -> None:
    subprocess.run([sys.executable, "-m", *map(str, arguments)], cwd=ROOT, check=True, capture_output=True, timeout=280)


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    folder = tmp_path_factory.mktemp("survey")
    run("scene.survey", "--length", LENGTH, "--seed", SEED, "--out", folder)
    return folder


@pytest.fixture(scope="module")
def scene(survey, tmp_path_factory):
    out = tmp_path_factory.mktemp("built") / "scene"
    poses = ("--trajectory", survey / "groundtruth.tum", "--provenance", "simulated")
    run("scene.build", survey / "survey.bag", *poses, "--out", out)
    return out


@pytest.fixture(scope="module")
def furniture(survey):
    return json.loads((survey / "truth.json").read_text())


def on_the_wall(bore: dict[str, np.ndarray], origin: np.ndarray) -> np.ndarray:
    """Positions of the pockets in the survey frame, m."""
    axis = make_axis(bore["station"], bore["position"], bore["tangent"])
    pocket = bore["pocket"]
    at = axis.at(pocket["station"])
    row = np.rint(pocket["station"] / bore["station"][1]).astype(int).clip(0, len(bore["station"]) - 1)
    radius = [
        np.interp(a, bore["angle"], bore["radius"][k], period=2 * np.pi)
        for a, k in zip(pocket["angle"], row, strict=True)
    ]
    across, along = radius * np.cos(pocket["angle"]), radius * np.sin(pocket["angle"])
    return at.position + across[:, None] * at.lateral + along[:, None] * at.up + origin


def test_axis_width_height_and_length_are_within_two_centimetres_of_the_truth(survey, scene):
    figures = compare(scene, load_truth(survey / "truth.json")).figures()
    assert figures["centreline_rmse"] < 0.02
    assert figures["width_rmse"] < 0.02
    assert figures["height_rmse"] < 0.02
    assert abs(figures["length_error"]) < 0.15


def test_pockets_are_found_where_they_are_with_size_and_depth(scene, furniture):
    with np.load(scene / "bore.npz") as data:
        bore = {name: data[name] for name in data.files}
    origin = np.asarray(json.loads((scene / "manifest.json").read_text())["frame"]["origin"])
    true = np.array([pocket["position"] for pocket in furniture["pockets"] if pocket["open"]])
    distance, which = cKDTree(true).query(on_the_wall(bore, origin))
    hits = len(set(which[distance < 0.15]))
    assert 2 * hits / (len(distance) + len(true)) > 0.9
    assert bore["pocket"]["depth"].mean() == pytest.approx(0.13, abs=0.015)
    assert bore["pocket"]["length"].mean() == pytest.approx(0.20, abs=0.03)
    assert bore["pocket"]["width"].mean() == pytest.approx(0.18, abs=0.03)
    assert np.median(np.diff(bore["ring_station"])) == pytest.approx(1.5, abs=0.01)


def test_sleepers_lie_where_the_survey_shows_them(scene, furniture):
    manifest = json.loads((scene / "manifest.json").read_text())
    assert manifest["track"]["sleepers_seen"] == pytest.approx(len(furniture["sleepers"]["station"]), abs=2)
    assert manifest["track"]["protrusion"] == pytest.approx(0.06, abs=0.01)
    assert manifest["track"]["gauge_seen"] == pytest.approx(1.435, abs=0.01)
    assert manifest["provenance"]["sleepers"] == "simulated"


def test_a_simulated_survey_is_labelled_so_everywhere(scene):
    manifest = json.loads((scene / "manifest.json").read_text())
    assert manifest["input_provenance"] == "simulated"
    assert "measured" not in manifest["provenance"].values()
    with np.load(scene / "tunnel.npz") as tunnel:
        assert str(tunnel["provenance"]) == "simulated"
