"""The commands on a short tube: what they read, keep, judge, draw and say where every metric's value is given."""

import csv
import json
import shutil
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from dataclasses import replace
from functools import cache
from hashlib import sha256
from io import StringIO
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure

from benchmarks.fidelity import inputs, judge, registry, table
from benchmarks.fidelity.__main__ import main
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.faults import runner
from benchmarks.fidelity.files import file_hash
from benchmarks.fidelity.inputs import Inputs, complete_inputs, read_case
from benchmarks.fidelity.references import HoldConfig
from benchmarks.fidelity.registry import Value
from benchmarks.fidelity.report.figures import FIGURES, Sheet
from benchmarks.fidelity.table import Metric
from tests.benchmarks.fidelity import tube, tubescene
from tests.benchmarks.fidelity.test_verdicts import values
from tests.benchmarks.fidelity.tube import Tube
from tests.recorded import check

TABLE = Path(__file__).with_name("commands.csv")
SHORT = Tube(length=15.0)
OFF = replace(SHORT, width=5.66, depth=0.11, gauge=1.437)
BEAMS = 2500
VOLATILE = ("code_hash", "commit", "versions", "constants", "split")


def fidelity(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    """`python -m benchmarks.fidelity`, in this process; its exit status."""
    monkeypatch.setattr(sys, "argv", ["fidelity", *map(str, words)])
    return main()


class Here(ThreadPoolExecutor):
    """Stands for a pool of processes, in a thread of this one; those that were made are listed."""

    made: ClassVar[list[int]] = []

    def __init__(self, processes: int, context: object, *start: Any) -> None:
        super().__init__(1, "", *start)
        self.made.append(processes)


known = cache(values)


def given(case: Case, row: Metric) -> Value:
    """Values given to metrics: the truth is the best, then the reconstruction, unless it was moved to one side."""
    aside = np.abs(case.candidate.lining.vertices[:5] - tube.candidate(OFF).lining.vertices[:5]).max() > 0.05
    if case.candidate.name == "tube":
        return known(0.98, ("CEN", "C2M", "F2D", "TRK") if aside else (), 0.3)[row.id]
    return known(1.0 if case.candidate.name == "truth" else 0.8)[row.id]


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return tubescene.write(tmp_path_factory.mktemp("commands") / "tube", OFF)


@pytest.fixture(scope="module")
def recording(scene) -> tuple[Path, Path]:
    tubescene.write_truth(scene.parent, tube.truth(SHORT))
    return tubescene.record(scene.parent, SHORT, beams=BEAMS)


@pytest.fixture(scope="module")
def ran(scene, recording, tmp_path_factory) -> Callable[..., tuple[Path, str]]:
    """Runs a command with every metric's value given, one at a time; its folder, and what it says."""

    @cache
    def once(command: str, *words: object, out: Path | None = None) -> tuple[Path, str]:
        folder = out or tmp_path_factory.mktemp(command)
        files = ("--scene", scene, "--recording", recording[0], "--trajectory", recording[1], "--truth", scene.parent)
        with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as said:
            patch.setattr(registry, "compute_metric", given)
            for module in (judge, registry, runner):  # it walks everything that all tests hold
                patch.setattr(module, "release_memory", lambda: None)
            for module in (judge, inputs, runner):
                patch.setattr(module, "ProcessPoolExecutor", Here)
            assert fidelity(patch, command, *files, "--out", folder, *words) == 0
        return folder, said.getvalue()

    return once


def test_a_run_reports_what_it_was_given(ran, tmp_path) -> None:
    folder, said = ran("run", "--processes", 1)
    report = json.loads((folder / "report.json").read_text())
    assert f"{report['verdict']}, global {report['global']:.1f} % over 18 of 18 categories" in said
    check(TABLE, "run", {name: value for name, value in report.items() if name not in VOLATILE})
    kept = json.loads((folder / "windows.json").read_text())
    worst = {row["id"] + row["source"]: row["value"] for row in kept["worst"] if row["value"] is not None}
    assert worst["sectortruth"] == pytest.approx(0.03, abs=0.003)  # either wall of a tube 6 cm too wide
    assert worst["gaugetruth"] == pytest.approx(0.002, abs=2e-4)
    assert any(len(repr(value)) > 12 for value in worst.values())  # all digits: what is read again is the same
    second = shutil.copytree(folder, tmp_path / "second", ignore=lambda *_: ["values.json"])
    ran("run", "--processes", 2, out=second)
    assert json.loads((second / "report.json").read_text()) == report
    kept = [json.loads((one / "values.json").read_text())["values"] for one in (folder, second)]
    assert kept[0] == kept[1]
    assert kept[0]["null"]["mj_ray_vs_mesh_mae"] == kept[0]["base"]["mj_ray_vs_mesh_mae"]
    assert kept[0]["null"]["c2m_mean"] != kept[0]["base"]["c2m_mean"] != kept[0]["ceiling"]["c2m_mean"]


def test_controls_are_judged_against_the_run_and_stand_in_its_report(ran, tmp_path) -> None:
    folder = shutil.copytree(ran("run", "--processes", 1)[0], tmp_path / "controls")
    Here.made.clear()
    ran("controls", "--only", "N07", "I6", "--bold-only", "--processes", 2, out=folder)
    assert Here.made == [2]
    rows = json.loads((folder / "controls.json").read_text())["rows"]
    check(TABLE, "controls", rows)
    assert (rows[0]["detected"], rows[1]["quiet"]) == (True, True)
    found = json.loads((folder / "report.json").read_text())["controls"]
    assert found == {"run": 2, "complete": False, "undetected": [], "loud": []}
    assert "N07" in (folder / "controls.csv").read_text()


def test_the_ladder_says_at_which_size_most_places_are_noticed(ran, monkeypatch) -> None:
    before = tube.candidate(OFF).lining.vertices
    monkeypatch.setattr(runner, "noticed_by", lambda case, _: ("w",) if np.abs(
        case.candidate.lining.vertices - before).max() > 0.03 else ())  # fmt: skip
    folder, said = ran("faults", "--kinds", "wall", "rails", "--places", 2)
    assert "wall over 5 m: 3.1 cm; 5 cm noticed at 2 of 2" in said
    assert "rails over 5 m: inf cm; 2 cm noticed at 0 of 2" in said
    assert (
        (folder / "ladder.csv").read_text().splitlines()[1].startswith("wall,one wall in or out,m,5,2,0.05,2,0.03149")
    )


def test_a_metric_from_a_file_is_listed_apart(ran, tmp_path) -> None:
    before, _ = ran("run", "--processes", 1)
    out = Path(shutil.copytree(before, tmp_path / "out"))  # its values are read again, not computed
    file = tmp_path / "my_metrics.py"
    file.write_text(_code_of_the_guide())
    _, said = ran("run", "--processes", 1, "--metrics", file, out=out)
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


def test_worst_windows_alone_are_said_with_their_places(ran) -> None:
    _, said = ran("windows")
    assert "windows of tube: " in said
    check(TABLE, "windows", {"said": said.splitlines()})


def test_what_is_drawn_is_what_it_was(ran, scene, recording) -> None:
    folder, _ = ran("run", "--processes", 1)
    given = Inputs(scene=scene, recording=recording[0], trajectory=recording[1], truth=scene.parent)
    sheet = Sheet(read_case(complete_inputs(given)), json.loads((folder / "report.json").read_text()))
    assert {file.stem for file in (folder / "figures").glob("*.png")} == {name for name, *_ in FIGURES}
    for name, draw, _ in FIGURES:
        figure, caption = draw(sheet)
        check(TABLE, f"figure {name}", {"caption": caption} | contents(figure), 1e-3)


def contents(figure: Figure) -> dict[str, Any]:
    """Numbers and words of a picture, panel by panel."""
    panels = {}
    for number, axes in enumerate(figure.axes):
        meshes = [one for one in axes.collections if isinstance(one, QuadMesh)]
        panels[f"panel {number}"] = {
            "images": [np.ma.filled(np.ma.asarray(one.get_array(), float), np.nan) for one in axes.images],
            "extents": [np.array(one.get_extent()) for one in axes.images],
            "meshes": [np.ma.filled(np.ma.asarray(one.get_array(), float), np.nan) for one in meshes],
            "corners": [np.asarray(one.get_coordinates()) for one in meshes],
            "lines": [one.get_xydata() for one in axes.lines],
            "boxes": [np.array(one.get_extents().bounds) for one in axes.patches] if meshes else [],
            "words": [axes.get_title(), axes.get_xlabel(), axes.get_ylabel(), *(one.get_text() for one in axes.texts)],
            "limits": np.array([*axes.get_xlim(), *axes.get_ylim()]),
        }  # fmt: skip
    return panels


def test_a_recording_is_read_as_it_was_written(scene, recording) -> None:
    written = tube.hold(SHORT, beams=BEAMS, spacing=1.05)
    given = Inputs(scene=scene, recording=recording[0], trajectory=recording[1])
    read = read_case(given).hold
    assert (read.sigma, read.range_max, read.sensor, read.knows_missing) == (0.02, 100.0, "/livox/lidar", False)
    assert read.hash == sha256(recording[0].read_bytes()).hexdigest()
    np.testing.assert_allclose(read.points, written.points, atol=1e-5)
    np.testing.assert_allclose(read.origin, written.origin, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(read.direction, axis=1), 1.0, rtol=1e-6)
    few = read_case(replace(given, hold=HoldConfig(scan_spacing=2.0, beams_per_scan=1000))).hold
    assert np.bincount(few.scan).tolist() == [1000, 0] * 6 + [1000]
    assert np.ptp(few.time[few.scan == 0]) == pytest.approx(np.ptp(read.time[read.scan == 0]), rel=0.01)
    poses = np.loadtxt(recording[1])
    late = tubescene.write_tum(scene.parent / "late.tum", poses[poses[:, 0] > poses[4, 0] - 0.01])
    assert set(read_case(replace(given, trajectory=late)).hold.scan) == set(range(2, 14))


def test_the_packaged_scene_and_a_foreign_one_are_made_by_commands_where_they_are_missing(
    monkeypatch, tmp_path
) -> None:
    made: list[str] = []

    def make(module: str, *words: object) -> None:
        made.append(" ".join(map(str, (module, *words))))
        out = Path(str(words[-1]))
        out.mkdir(parents=True, exist_ok=True)
        (out / "survey.bag").write_text("a")
        (out / "survey_os1.bag").write_text("b")
        (out / "manifest.json").write_text(json.dumps({"inputs": [{"sha256": sha256(b"a").hexdigest()}]}))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(inputs, "make", make)
    found = complete_inputs(Inputs(seed=3))
    assert made == [
        "scene.survey --truth metro --length 351 --seed 0 --sensors avia os1 --scan-every 10 --out build/survey-351",
        "scene.build build/survey-351/survey.bag --trajectory build/survey-351/groundtruth.tum "
        "--provenance simulated --name subterra-351 --out build/subterra-351",
    ]
    assert (found.scene, found.seed) == (Path("build/subterra-351"), 3)
    assert {found.recording.name, found.trajectory.name} == {"survey_os1.bag", "groundtruth_os1.tum"}
    assert {found.fit_recording.name, found.fit_trajectory.name} == {"survey.bag", "groundtruth.tum"}
    complete_inputs(Inputs())
    assert len(made) == 2
    (tmp_path / "build/survey-351/survey.bag").write_text("another")
    complete_inputs(Inputs())
    assert len(made) == 3
    case = tube.case(SHORT, beams=60)
    for _ in range(2):
        assert inputs.foreign_scene(case, tmp_path) == tmp_path / "foreign-scene"
    assert made[3:] == [
        f"scene.survey --length 15 --seed 1000 --out {tmp_path}/foreign-survey",
        f"scene.build {tmp_path}/foreign-survey/survey.bag --trajectory {tmp_path}/foreign-survey/groundtruth.tum "
        f"--provenance simulated --out {tmp_path}/foreign-scene",
    ]


@pytest.fixture
def own_scene(scene, tmp_path) -> Path:
    """A copy to corrupt, whose manifest has the hashes of its files."""
    folder = Path(shutil.copytree(scene, tmp_path / "tube"))
    manifest = json.loads((folder / "manifest.json").read_text())
    names = [f.relative_to(folder).as_posix() for f in folder.rglob("*") if f.is_file() and f.name != "manifest.json"]
    manifest["files"] = {name: file_hash(folder / name) for name in names}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


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
