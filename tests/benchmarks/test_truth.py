"""A bore against the truth of its survey."""

import json
import re

import matplotlib.pyplot as plt
import numpy as np
import pytest

from benchmarks import report
from benchmarks.truth import compare, load_truth


def write_case(folder, shift=(0.0, 0.0, 0.0), width=5.65, end=40.0):
    """A straight bore along x, and its truth; the bore shifted and sized as asked."""
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


def test_a_file_of_another_schema_is_refused(tmp_path):
    (tmp_path / "t.json").write_text(json.dumps({"schema": "x"}))
    with pytest.raises(ValueError, match="schema is x"):
        load_truth(tmp_path / "t.json")


def test_a_page_refers_to_nothing_outside_itself():
    figure, axes = plt.subplots()
    axes.plot([0, 1])
    parts = [
        report.html_text("A & B", "h2"),
        report.html_figure(figure, "a line"),
        report.html_figure(np.zeros((4, 4, 3), np.uint8), "a picture"),
        report.html_table(("What", "Value"), [(("x < y", "1"), True)]),
    ]
    assert figure.number not in plt.get_fignums(), "an embedded figure is closed"
    text = report.html_page("T", parts)
    assert all(source.startswith("data:image/png;base64,") for source in re.findall(r'src="([^"]*)"', text))
    assert "http" not in text
    assert "A &amp; B" in text
    assert "x &lt; y" in text
    assert '<tr class="missed">' in text
