"""The command from end to end on a short tube: files in, a whole report out; and what is wrong with a scene."""

import csv
import json
import shutil
import sys
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fidelity.__main__ import main
from benchmarks.fidelity.files import file_hash
from tests.benchmarks.fidelity import tubescene
from tests.benchmarks.fidelity.tube import Tube, hold
from tests.scene.bags import write_bag, write_tum

SHORT = Tube(length=12.0)


def fidelity(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    """`python -m benchmarks.fidelity`, in this process."""
    monkeypatch.setattr(sys, "argv", ["fidelity", *map(str, words)])
    main()


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return tubescene.write(tmp_path_factory.mktemp("whole") / "tube", SHORT)


@pytest.fixture
def own_scene(scene, tmp_path) -> Path:
    """A copy to spoil, whose manifest has the hashes of its files."""
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


@pytest.mark.timeout(900)  # a minute of one core, on a machine that may be busy
def test_a_run_scores_all_18_categories_of_a_right_tube(scene, recording, tmp_path, monkeypatch, capsys) -> None:
    words = ("run", "--scene", scene, "--recording", recording[0], "--trajectory", recording[1],
             "--beams-per-scan", 9000, "--out", tmp_path)  # fmt: skip
    fidelity(monkeypatch, *words)
    assert "warp" not in "".join(capsys.readouterr())
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["title"] == "Fidelity"
    assert len(report["metrics"]) == 199
    assert [m["id"] for m in report["metrics"] if m["status"] == "failed"] == []
    scores = {name: entry["score"] for name, entry in report["categories"].items()}
    assert len(scores) == report["categories_evaluated"] == 18, scores
    assert report["global"] > 90.0, scores
    assert report["global"] > report["global_null"]
    assert report["split"]["hold"]["sha256"] == sha256(recording[0].read_bytes()).hexdigest()
    with (tmp_path / "metrics.csv").open(newline="") as file:
        assert sum(1 for _ in csv.DictReader(file)) == 199
    for name in ("report.html", "report.md", "categories.csv", "junit.xml", "figures/F01-voxels.png"):
        assert (tmp_path / name).stat().st_size > 0


def _mesh_gone(folder: Path) -> str:
    (folder / "meshes" / "lining_000.obj").unlink()
    return f"{folder}/meshes/lining_000.obj: is missing, though manifest.json names it"


def _mesh_changed(folder: Path) -> str:
    with (folder / "meshes" / "lining.ply").open("ab") as file:
        file.write(b" ")
    return f"{folder}/meshes/lining.ply: its SHA-256 is not that of manifest.json; it changed after the build"


def _old_schema(folder: Path) -> str:
    path = folder / "manifest.json"
    path.write_text(path.read_text().replace("subterra.manifest/1", "subterra.manifest/0"))
    return f"{path}: schema is subterra.manifest/0, not subterra.manifest/1; build the scene anew"


def _no_manifest(folder: Path) -> str:
    (folder / "manifest.json").write_text("{")
    return f"{folder}/manifest.json: is no manifest"


def _mesh_gone_from_an_older_scene(folder: Path) -> str:
    path = folder / "manifest.json"
    manifest = {name: value for name, value in json.loads(path.read_text()).items() if name != "files"}
    path.write_text(json.dumps(manifest))
    (folder / "meshes" / "lining_000.obj").unlink()
    return f"{folder}: cannot be read as a scene"


@pytest.mark.parametrize(
    "spoil", [_mesh_gone, _mesh_changed, _old_schema, _no_manifest, _mesh_gone_from_an_older_scene]
)
def test_what_is_wrong_with_a_scene_is_said_in_one_sentence(own_scene, tmp_path, monkeypatch, capsys, spoil) -> None:
    expected = spoil(own_scene)
    with pytest.raises(SystemExit) as ended:
        fidelity(monkeypatch, "run", "--scene", own_scene, "--out", tmp_path / "out")
    assert ended.value.code == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith(f"error: {expected}")
    assert "\n" not in said
    assert not (tmp_path / "out").exists()


def test_a_fit_recording_that_the_builder_did_not_read_is_refused(
    scene, recording, tmp_path, monkeypatch, capsys
) -> None:
    with pytest.raises(SystemExit) as ended:
        fidelity(monkeypatch, "run", "--scene", scene, "--fit-recording", recording[0],
                 "--fit-trajectory", recording[1], "--out", tmp_path / "out")  # fmt: skip
    assert ended.value.code == 2
    assert "held_out.bag: is not what" in capsys.readouterr().err


def test_a_folder_of_scans_has_the_hash_that_the_builder_records(tmp_path) -> None:
    for name in ("a.ply", "b.ply"):
        (tmp_path / name).write_text(name)
    lines = "".join(f"{name} {sha256(name.encode()).hexdigest()}\n" for name in ("a.ply", "b.ply"))
    assert file_hash(tmp_path) == sha256(lines.encode()).hexdigest()
