"""The command from end to end on a short tube: files in, a whole report out."""

import csv
import gc
import json
from hashlib import sha256
from pathlib import Path

import pytest

from benchmarks.fidelity import judge, table
from benchmarks.fidelity.report.figures import FIGURES
from tests.benchmarks.fidelity import tubescene
from tests.benchmarks.fidelity.test_commands import fidelity
from tests.benchmarks.fidelity.tube import Tube


@pytest.mark.timeout(900)  # a minute of one core, on a machine that may be busy
def test_a_run_scores_all_18_categories_of_a_right_tube(tmp_path: Path, monkeypatch, capsys) -> None:
    short, out = Tube(length=12.0), tmp_path / "out"
    scene, recording = tubescene.write(tmp_path / "tube", short), tubescene.record(tmp_path, short, beams=9000)
    words = ("--scene", scene, "--recording", recording[0], "--trajectory", recording[1], "--beams-per-scan", 9000)
    gc.collect()
    gc.freeze()  # the suite collects garbage after every block of metrics: not among what other tests hold
    assert fidelity(monkeypatch, "run", *words, "--out", out) == 0
    said, report = capsys.readouterr().out, json.loads((out / "report.json").read_text())
    assert "warp" not in said
    assert len(report["metrics"]) == len(table.load())
    assert [m["id"] for m in report["metrics"] if m["status"] == "failed"] == []
    scores = {name: entry["score"] for name, entry in report["categories"].items()}
    assert len(scores) == report["categories_evaluated"] == 18, scores
    assert report["global"] > 90.0, scores
    assert report["global"] > report["global_null"]
    assert report["split"]["hold"]["sha256"] == sha256(recording[0].read_bytes()).hexdigest()
    assert report["constants"] == judge.constants_digest()
    assert report["constants"] in (out / "report.html").read_text()
    with (out / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(table.load())
    assert "source" not in rows[0]
    assert "is left out" not in said
    assert {file.stem for file in (out / "figures").glob("*.png")} == {name for name, *_ in FIGURES}
