"""A simulated survey through the builder, against the survey's own truth. Neither knows the other's code."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.truth import compare, load_truth
from scene import build as pipeline
from scene.build import build
from scene.config import BuildConfig
from scene.geometry import make_axis
from scene.poses import place
from scene.reading.rosbag import RosBag
from tests.scene.conftest import Simulated


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


def test_axis_width_height_and_length_are_within_two_centimetres_of_the_truth(simulated):
    figures = compare(simulated.scene, load_truth(simulated.survey / "truth.json")).figures()
    assert figures["centreline_rmse"] < 0.02
    assert figures["width_rmse"] < 0.02
    assert figures["height_rmse"] < 0.02
    assert abs(figures["length_error"]) < 0.15


def test_pockets_are_found_where_they_are_with_size_and_depth(simulated):
    with np.load(simulated.scene / "bore.npz") as data:
        bore = {name: data[name] for name in data.files}
    origin = np.asarray(json.loads((simulated.scene / "manifest.json").read_text())["frame"]["origin"])
    held = [pocket for pocket in simulated.truth["pockets"] if pocket["open"]]
    true = np.array([pocket["position"] for pocket in held])
    distance, which = cKDTree(true).query(on_the_wall(bore, origin))
    hits = len(set(which[distance < 0.15]))
    assert 2 * hits / (len(distance) + len(true)) > 0.9
    for size, within in (("depth", 0.015), ("length", 0.03), ("width", 0.03)):
        assert bore["pocket"][size].mean() == pytest.approx(np.mean([pocket[size] for pocket in held]), abs=within)
    assert np.median(np.diff(bore["ring_station"])) == pytest.approx(simulated.truth["rings"]["width"], abs=0.01)


def test_sleepers_lie_where_the_survey_shows_them(simulated):
    track = json.loads((simulated.scene / "manifest.json").read_text())["track"]
    assert track["sleepers_seen"] == pytest.approx(len(simulated.truth["sleepers"]["station"]), abs=2)
    assert track["protrusion"] == pytest.approx(0.06, abs=0.01)
    assert track["gauge_seen"] == pytest.approx(simulated.truth["rails"]["gauge"], abs=0.01)


def test_a_simulated_survey_is_labelled_so_everywhere(simulated):
    manifest = json.loads((simulated.scene / "manifest.json").read_text())
    assert manifest["input_provenance"] == "simulated"
    assert manifest["provenance"]["sleepers"] == "simulated"
    assert "measured" not in manifest["provenance"].values()
    with np.load(simulated.scene / "tunnel.npz") as tunnel:
        assert str(tunnel["provenance"]) == "simulated"


NAMED = BuildConfig(provenance="simulated")


class Killed(BaseException):
    """End of a build as by a signal: nothing catches it."""


def test_a_build_reads_twice_and_the_one_after_a_kill_reads_nothing_and_writes_the_same(
    simulated: Simulated, tmp_path, monkeypatch, capsys
):
    passes = []
    scans = RosBag.scans

    def counted(self, only=None):
        passes.append("whole" if only is None else "some")
        return scans(self, only)

    def kill(*_):
        raise Killed

    survey, out = simulated.survey, tmp_path / "scene"
    monkeypatch.setattr(RosBag, "scans", counted)
    with monkeypatch.context() as until:
        until.setattr(pipeline, "clean_cloud", kill)
        with pytest.raises(Killed):
            build(survey / "survey.bag", out, survey / "groundtruth.tum", NAMED)
    assert passes.count("whole") == 2  # for the times of all sweeps, and to place them
    assert not out.exists()
    (kept,) = tmp_path.iterdir()

    monkeypatch.setattr(place, "register_scans", kill)
    passes.clear()
    build(survey / "survey.bag", out, survey / "groundtruth.tum", NAMED)
    assert not passes
    assert str(kept) in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == [out]
    files = [file.relative_to(simulated.scene) for file in simulated.scene.rglob("*") if file.is_file()]
    assert all((out / file).read_bytes() == (simulated.scene / file).read_bytes() for file in files)


def test_other_settings_or_another_recording_take_nothing_that_was_kept(tmp_path):
    bag = tmp_path / "a.bag"
    bag.write_text("one")
    out = tmp_path / "scene"
    first = pipeline.find_kept(out, [bag], (0.04,))
    assert first == pipeline.find_kept(out, [bag], (0.04,))
    assert first != pipeline.find_kept(out, [bag], (0.05,))
    bag.write_text("other")
    assert first != pipeline.find_kept(out, [bag], (0.04,))
    first.write_text("stale")
    pipeline.forget_kept(out)
    assert list(tmp_path.iterdir()) == [bag]
