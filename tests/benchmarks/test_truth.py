import json

import numpy as np
import pytest

from benchmarks.truth import Placement, compare, load_truth, start_placement


def write_case(folder, shift=(0.0, 0.0, 0.0), width=5.65, end=40.0, turn=None):
    """A straight bore along x, and its truth; the bore shifted, sized and turned as asked."""
    station = np.arange(0.0, 40.01, 0.25)
    position = np.column_stack([station, np.zeros((len(station), 2))])
    truth = {
        "schema": "subterra.truth/1",
        "station": station.tolist(),
        "position": (position + np.array([100.0, 50.0, 7.0])).tolist(),
        "width": [5.65] * len(station),
        "height": [6.36] * len(station),
    }
    (folder / "truth.json").write_text(json.dumps(truth))
    bore_station = np.arange(0.0, end + 0.01, 0.25)
    bore = np.column_stack([bore_station, np.zeros((len(bore_station), 2))]) + shift
    if turn is not None:
        bore = bore @ turn.T
    np.savez(
        folder / "bore.npz",
        station=bore_station,
        position=bore,
        width=np.full(len(bore_station), width),
        height=np.full(len(bore_station), 6.36),
    )
    (folder / "manifest.json").write_text(json.dumps({"frame": {"origin": [100.0, 50.0, 7.0]}}))
    return load_truth(folder / "truth.json")


def test_a_perfect_bore_has_no_error(tmp_path):
    figures = compare(tmp_path, write_case(tmp_path)).figures()
    assert all(abs(value) < 1e-3 for value in figures.values()), figures


def test_a_shifted_wider_longer_bore_is_off_by_just_that(tmp_path):
    truth = write_case(tmp_path, shift=(0, 0.03, -0.04), width=5.70, end=41.0)
    comparison = compare(tmp_path, truth)
    assert comparison.figures()["centreline_rmse"] == pytest.approx(0.05, abs=1e-4)
    assert comparison.lateral.mean() == pytest.approx(0.03, abs=1e-4)
    assert comparison.vertical.mean() == pytest.approx(-0.04, abs=1e-4)
    assert comparison.figures()["width_rmse"] == pytest.approx(0.05, abs=1e-4)
    assert comparison.length_error == pytest.approx(1.0, abs=1e-6)


def test_a_placement_brings_a_turned_bore_back(tmp_path):
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    truth = write_case(tmp_path, turn=turn)
    origin = np.array([100.0, 50.0, 7.0])
    back = Placement(turn.T, origin - turn.T @ origin)
    assert compare(tmp_path, truth, back).figures()["centreline_rmse"] < 1e-3


def test_the_start_placement_puts_the_first_pose_on_the_truth(tmp_path):
    (tmp_path / "estimate.tum").write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    half = np.sqrt(0.5)
    rows = [f"{t} {5 + t} 3 2 0 0 {half} {half}" for t in (0, 1, 2)]
    (tmp_path / "truth.tum").write_text("\n".join(rows))
    placement = start_placement(tmp_path / "estimate.tum", tmp_path / "truth.tum")
    np.testing.assert_allclose(placement.rotation @ [1, 0, 0] + placement.shift, [6, 4, 2], atol=1e-9)


def test_a_file_of_another_schema_is_refused(tmp_path):
    (tmp_path / "t.json").write_text(json.dumps({"schema": "x"}))
    with pytest.raises(ValueError, match="schema is x"):
        load_truth(tmp_path / "t.json")
