"""A format that the package does not know, read by a module of the user's own."""

import re
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scene.build import build
from scene.errors import RecordingError
from scene.reading import RawScan, ScanSource, formats, make_scan, register_reader
from scene.reading.formats import detect, load_reader
from scene.reading.recording import Recording
from subterra_jax.host.loading import UserCodeError, load_module

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "guide" / "extend.md"
START = 1317376510.25


@pytest.fixture(autouse=True)
def table(monkeypatch: pytest.MonkeyPatch) -> None:
    """The table of formats as it was, whatever a test adds."""
    monkeypatch.setattr(formats, "_own", {})
    for name in [name for name in sys.modules if name.startswith("zip_reader_")]:
        monkeypatch.delitem(sys.modules, name)


@pytest.fixture
def reader(tmp_path: Path) -> Path:
    """The reader of the page about extensions, as its reader saves it."""
    file = tmp_path / "zip_reader.py"
    file.write_text(re.search(r"`zip_reader\.py`:\n\n```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[1])
    return file


def write_zip(path: Path, scans: list[np.ndarray]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for k, points in reversed(list(enumerate(scans))):
            archive.writestr(f"{START + 0.1 * k:.2f}.ply", trimesh.PointCloud(points).export(file_type="ply"))
    return path


def test_a_zip_of_ply_scans_is_read_by_a_file_outside_the_package(reader, tmp_path):
    points = np.random.default_rng(0).uniform(1, 9, (3, 30, 3)).astype(np.float32)
    load_reader(str(reader))
    with Recording(write_zip(tmp_path / "walk.zip", points)) as recording:
        scans = list(recording.scans())
        facts = recording.peek()
    assert [scan.stamp for scan in scans] == pytest.approx([START, START + 0.1, START + 0.2])
    for scan, known in zip(scans, points, strict=True):
        np.testing.assert_array_equal(scan.points, known)
    assert facts["kind"] == "zip of PLY scans"
    assert facts["format_by"] == "name"
    assert "static" in facts["point_times"]


def test_a_damaged_scan_is_named(reader, tmp_path):
    load_module(str(reader))
    path = tmp_path / "walk.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("1.0.ply", "ply\nnonsense\n")
    with Recording(path) as recording, pytest.raises(RecordingError, match=r"walk\.zip: scan 0 is not readable"):
        list(recording.scans())
    path.write_text("no archive")
    with pytest.raises(RecordingError, match=r"walk\.zip: not a readable zip of PLY scans"):
        Recording(path)


def test_a_cloud_format_of_ones_own_is_found_by_its_first_bytes(tmp_path):
    register_reader("mine", lambda path: None, kind="cloud", magic=(b"MINE",))
    (tmp_path / "cloud.dat").write_bytes(b"MINE and more")
    detected = detect(tmp_path / "cloud.dat")
    assert (detected.format.name, detected.by) == ("mine", "content")


def test_names_of_the_package_and_kinds_of_no_meaning_are_refused():
    with pytest.raises(ValueError, match="'ply' is one of this package"):
        register_reader("ply", lambda path: None)
    with pytest.raises(ValueError, match="kind must be recording or cloud, got 'rings'"):
        register_reader("mine", lambda path: None, kind="rings")


@pytest.mark.parametrize(
    ("text", "cause"), [(None, "No such file"), ("1 / 0", "division by zero"), ("import nowhere_at_all", "nowhere")]
)
def test_a_reader_that_cannot_be_loaded_is_one_sentence(tmp_path, text, cause):
    path = tmp_path / "broken.py"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UserCodeError, match=rf"broken\.py: .*{cause}"):
        build(tmp_path / "walk.zip", tmp_path / "out", reader=str(path))


def test_a_source_without_times_is_taken_as_static(tmp_path):
    def read(index: int) -> RawScan:
        return make_scan(float(index), np.ones((4, 3)), None)

    source = ScanSource(tmp_path, 2, {"kind": "mine"}, read)
    assert [scan.stamp for scan in source.scans()] == [0.0, 1.0]
    assert [scan.stamp for scan in source.scans(only=frozenset([0]))] == [0.0]
