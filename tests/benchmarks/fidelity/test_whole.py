"""The command from end to end on a short tube: files in, a whole report out; and what is wrong with a scene."""

import csv
import gc
import json
import shutil
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from hashlib import sha256
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fidelity import judge, table
from benchmarks.fidelity import report as report_module
from benchmarks.fidelity.__main__ import main
from benchmarks.fidelity.files import file_hash
from benchmarks.fidelity.inputs import Inputs, read_case
from benchmarks.fidelity.references import HoldConfig
from benchmarks.fidelity.registry import compute_metric, dump_values
from benchmarks.fidelity.report.figures import FIGURES
from tests.benchmarks.fidelity import tubescene
from tests.benchmarks.fidelity.tube import Tube, hold
from tests.scene.bags import write_bag, write_tum

SHORT = Tube(length=12.0)


def fidelity(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    """`python -m benchmarks.fidelity`, in this process; its exit status."""
    monkeypatch.setattr(sys, "argv", ["fidelity", *map(str, words)])
    return main()


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return tubescene.write(tmp_path_factory.mktemp("whole") / "tube", SHORT)


@pytest.fixture
def own_scene(scene, tmp_path) -> Path:
    """A copy to corrupt, whose manifest has the hashes of its files."""
    folder = Path(shutil.copytree(scene, tmp_path / "tube"))
    manifest = json.loads((folder / "manifest.json").read_text())
    names = [f.relative_to(folder).as_posix() for f in folder.rglob("*") if f.is_file() and f.name != "manifest.json"]
    manifest["files"] = {name: file_hash(folder / name) for name in names}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


@pytest.fixture(scope="module")
def recording(scene) -> tuple[Path, Path]:
    """The tube's held-out beams as a bag of sweeps, and the poses of the sensor."""
    beams, origin = (
        hold(SHORT, beams=9000, spacing=1.05),
        np.asarray(SHORT.origin),
    )  # of scans a metre apart not all are scored
    scans, poses = [], []
    for number in np.unique(beams.scan):
        own = beams.scan == number
        stamp = float(beams.time[own][0])
        scans.append((stamp, beams.range[own, None] * beams.direction[own]))
        poses += [[stamp + late, *(beams.origin[own][0] + origin), 0, 0, 0, 1] for late in (0.0, 0.1)]
    folder = scene.parent
    return write_bag(folder / "held_out.bag", scans), write_tum(folder / "held_out.tum", np.array(poses))


@pytest.fixture(scope="module")
def scored(scene, recording, tmp_path_factory) -> tuple[Path, tuple[object, ...], str]:
    """Folder of a whole run, its words, and what it printed."""
    out = tmp_path_factory.mktemp("scored")
    words = ("run", "--scene", scene, "--recording", recording[0], "--trajectory", recording[1],
             "--beams-per-scan", 9000)  # fmt: skip
    gc.collect()
    gc.freeze()  # the suite collects garbage after every block of metrics: not among what other tests hold
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as said:
        assert fidelity(patch, *words, "--out", out) == 0
    return out, words, said.getvalue()


@pytest.mark.timeout(900)  # a minute of one core, on a machine that may be busy
def test_a_run_scores_all_18_categories_of_a_right_tube(scored, recording) -> None:
    folder, _, said = scored
    assert "warp" not in said
    report = json.loads((folder / "report.json").read_text())
    assert report["title"] == "Fidelity"
    assert len(report["metrics"]) == len(table.load())
    assert [m["id"] for m in report["metrics"] if m["status"] == "failed"] == []
    scores = {name: entry["score"] for name, entry in report["categories"].items()}
    assert len(scores) == report["categories_evaluated"] == 18, scores
    assert report["global"] > 90.0, scores
    assert report["global"] > report["global_null"]
    assert report["split"]["hold"]["sha256"] == sha256(recording[0].read_bytes()).hexdigest()
    assert report["outside"] is None
    assert report["constants"] == judge.constants_digest()
    assert report["constants"] in (folder / "report.html").read_text()
    with (folder / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(table.load())
    assert "source" not in rows[0]
    assert (folder / "report.html").stat().st_size > 0
    assert "is left out" not in said
    drawn = {file.stem for file in (folder / "figures").glob("*.png")}
    assert drawn == {name for name, *_ in FIGURES}


@pytest.mark.timeout(900)
def test_what_a_second_process_computed_is_what_this_one_computes(scored, scene, recording) -> None:
    folder, words, _ = scored
    kept = json.loads((folder / "values.json").read_text())["values"]
    assert list(kept) == ["base", "null"]
    beams = Inputs(scene=scene, recording=recording[0], trajectory=recording[1],
                   hold=HoldConfig(beams_per_scan=int(str(words[-1]))))  # fmt: skip
    case = read_case(beams)
    for name in ("base", "null"):
        one = replace(case, candidate=judge.make_candidates(case)[name](), cache={})
        for id in ("c2m_median", "free3d_iou", "topo_leak_frac", "lin_depth_map_ncc"):
            here = dump_values({id: compute_metric(one, table.load()[id])})
            assert kept[name][id] == json.loads(json.dumps(here[id])), id
    for id, row in table.load().items():
        if row.category in ("SCN", "PAR"):
            assert kept["null"][id] == kept["base"][id], id
    assert all("taken from another" not in row["reason"] for values in kept.values() for row in values.values())


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_metric_from_a_file_is_listed_apart(scored, tmp_path, monkeypatch, capsys) -> None:
    before, words, _ = scored
    out = Path(shutil.copytree(before, tmp_path / "out"))  # its values are read again, not computed
    file = tmp_path / "my_metrics.py"
    file.write_text(_code_of_the_guide())
    monkeypatch.setattr(report_module, "draw_all", lambda folder, sheet: {})  # they are drawn in the run before
    assert fidelity(monkeypatch, *words, "--metrics", file, "--out", out) == 0
    said = capsys.readouterr().out
    assert "1 of 200 metrics from outside (my_metrics.py): global with them" in said
    assert "the verdict is that of the suite alone" in said
    suite, report = (json.loads((folder / "report.json").read_text()) for folder in (before, out))
    added = report.pop("outside")
    assert suite.pop("outside") is None
    assert report == suite  # nothing of the suite's own report moves
    (entry,) = added["metrics"]
    assert (entry["id"], entry["category"], entry["source"]) == ("lin_deep_pocket_ratio", "LIN", "my_metrics.py")
    assert entry["status"] == "scored"
    assert entry["value"] is not None
    assert entry["null_value"] == 0.0  # the null tube has no pockets
    assert (added["count"], added["count_with_suite"]) == (1, 200)
    assert added["files"] == {"my_metrics.py": sha256(file.read_bytes()).hexdigest()}
    own = [m["score"] for m in report["metrics"] if m["category"] == "LIN" and m["score"] is not None]
    assert added["categories"]["LIN"]["score"] == pytest.approx(np.mean([*own, entry["score"]]), abs=1e-6)
    shift = (added["categories"]["LIN"]["score"] - report["categories"]["LIN"]["score"]) / 18
    assert added["global"] - report["global"] == pytest.approx(shift, abs=1e-6)
    with (out / "metrics.csv").open(newline="") as opened:
        rows = list(csv.DictReader(opened))
    assert [row["source"] for row in rows] == ["suite"] * len(table.load()) + ["my_metrics.py"]
    html = (out / "report.html").read_text()
    assert "This verdict is the suite's own." in html
    assert "1 from outside (200 metrics in all)" in html


def _code_of_the_guide() -> str:
    """The example of the guide, as its reader would copy it."""
    pages = (Path(__file__).parents[3] / "docs" / "guide").glob("extend*.md")
    blocks = [block.split("```")[0] for page in pages for block in page.read_text().split("```python\n")[1:]]
    return next(block for block in blocks if "lin_deep_pocket_ratio" in block)


def _manifest(**entries: object) -> Callable[[Path], object]:
    """Changes entries of a manifest; none of its files is checked then."""

    def change(folder: Path, name: str = "manifest.json") -> None:
        (folder / name).write_text(json.dumps(json.loads((folder / name).read_text()) | {"files": {}} | entries))

    return change


def _bore(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], object]:
    def write(folder: Path) -> None:
        data = dict(np.load(_manifest()(folder) or folder / "bore.npz"))
        np.savez(folder / "bore.npz", **{**data, name: change(data[name])})

    return write


UNREAD, MALFORMED = ": cannot be read as a scene ", "/manifest.json: its name, frame, inputs or files are malformed"
WRONG = (
    (lambda folder: (folder / "meshes/lining_000.obj").unlink(), "/meshes/lining_000.obj: is missing, though"),
    (lambda folder: (folder / "meshes/lining.ply").write_text(""), "/meshes/lining.ply: its SHA-256 is not that of"),
    (_manifest(schema="subterra.manifest/0"), "/manifest.json: schema is subterra.manifest/0, not subterra.manifest/1"),
    (lambda folder: (folder / "manifest.json").write_text("{"), "/manifest.json: is no manifest"),
    (lambda folder: (_manifest()(folder), (folder / "meshes/lining_000.obj").unlink()), UNREAD),
    (lambda folder: (_manifest()(folder), (folder / "bore.npz").write_text("x" * 99)), UNREAD),
    (_manifest(frame={}), MALFORMED), (_manifest(frame={"origin": [0, 0]}), MALFORMED),
    (_manifest(inputs=["a"]), MALFORMED), (_manifest(files=["a"]), MALFORMED), (_manifest(name=None), MALFORMED),
    (_bore("position", lambda rows: rows * np.nan), UNREAD), (_bore("radius", lambda rows: rows[:5]), UNREAD),
    (_bore("station", lambda rows: rows[::-1]), UNREAD),
)  # fmt: skip


@pytest.mark.parametrize(("corrupt", "expected"), WRONG)
def test_a_broken_scene_is_one_sentence(own_scene, tmp_path, monkeypatch, capsys, corrupt, expected) -> None:
    corrupt(own_scene)
    assert fidelity(monkeypatch, "run", "--scene", own_scene, "--out", tmp_path / "out") == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith(f"error: {own_scene}{expected}")
    assert "\n" not in said
    assert not (tmp_path / "out").exists()


def test_a_fit_recording_of_another_builder_is_refused(scene, recording, tmp_path, monkeypatch, capsys) -> None:
    words = ("--fit-recording", recording[0], "--fit-trajectory", recording[1])
    assert fidelity(monkeypatch, "run", "--scene", scene, *words, "--out", tmp_path / "out") == 2
    assert "held_out.bag: is not what" in capsys.readouterr().err


def test_a_folder_of_scans_has_the_hash_that_the_builder_records(tmp_path) -> None:
    for name in ("a.ply", "b.ply"):
        (tmp_path / name).write_text(name)
    lines = "".join(f"{name} {sha256(name.encode()).hexdigest()}\n" for name in ("a.ply", "b.ply"))
    assert file_hash(tmp_path) == sha256(lines.encode()).hexdigest()
