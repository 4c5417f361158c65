"""References from their files: the truth of a survey, and beams without a return."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.fidelity import references
from benchmarks.fidelity.files import FidelityError
from scene.reading.times import Convention
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.tube import Tube
from tests.benchmarks.fidelity.tubescene import write_truth


@pytest.fixture
def known() -> references.Truth:
    return tube.truth(Tube(length=6.0))


@pytest.fixture
def folder(known: references.Truth, tmp_path: Path) -> Path:
    return write_truth(tmp_path, known)


def test_a_truth_is_read_as_it_was_written(known: references.Truth, folder: Path) -> None:
    read = references.load_truth(folder, known.origin)
    np.testing.assert_allclose(read.surface.vertices, known.surface.vertices, atol=1e-9)
    np.testing.assert_array_equal(read.surface.faces, known.surface.faces)
    np.testing.assert_array_equal(read.part, known.part)
    np.testing.assert_allclose(read.position, known.position, atol=1e-9)
    assert read.parts == known.parts
    assert read.furniture["rails"]["gauge"] == pytest.approx(1.435)


def test_a_truth_that_is_none_is_refused(known: references.Truth, folder: Path) -> None:
    path = folder / "truth.json"
    text = path.read_text()
    for old, new, why in (("subterra.truth/1", "a/0", "is a/0"), (text, "[1]", "list"), (text, text[:99], "char"),
                          ('"width"', '"wide"', "width"), ("0.0,", "", "in length")):  # fmt: skip
        path.write_text(text.replace(old, new, 1))
        with pytest.raises(FidelityError, match=rf"truth\.json: cannot be read with its truth\.ply \(.*{why}"):
            references.load_truth(folder, known.origin)


def test_a_folder_without_a_surface_has_no_truth(known: references.Truth, folder: Path) -> None:
    (folder / "truth.ply").write_text("ply")
    with pytest.raises(FidelityError, match="cannot be read"):
        references.load_truth(folder, known.origin)
    (folder / "truth.ply").unlink()
    with pytest.raises(FidelityError, match=r"holds no truth\.json with its truth\.ply"):
        references.load_truth(folder, known.origin)


POINT = np.dtype({
    "names": ["x", "y", "z", "t", "ring"], "formats": ["<f4", "<f4", "<f4", "<u4", "u1"],
    "offsets": [0, 4, 8, 20, 26], "itemsize": 48,
})  # fmt: skip
RINGS, COLUMNS = 16, 256


def beams(sense):
    elevation = np.deg2rad(np.linspace(20.0, -20.0, RINGS))[:, None]
    offset = np.deg2rad(np.tile([4.2, 1.4, -1.4, -4.2], RINGS // 4))[:, None]
    azimuth = np.pi + sense * 2 * np.pi * np.arange(COLUMNS) / COLUMNS + offset
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation) + 0 * azimuth], axis=-1)


def sweep(sense=-1, lost=0.3, seed=0):
    rng = np.random.default_rng(seed)
    look = beams(sense)
    points = look * rng.uniform(2.0, 9.0, (RINGS, COLUMNS, 1))
    points[rng.random((RINGS, COLUMNS)) < lost] = 0.0
    return look, points


def recording(points, height=RINGS):
    data = np.zeros((RINGS, COLUMNS), POINT)
    for k, axis in enumerate("xyz"):
        data[axis] = points[..., k]
    data["t"] = np.arange(COLUMNS) * 390_625
    fields = [SimpleNamespace(name=n, datatype={"f": 7, "u": 6 if n == "t" else 2}[POINT[n].kind],
                              offset=POINT.fields[n][1]) for n in POINT.names]  # fmt: skip
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=1000, nanosec=0)), height=height, width=data.size // height,
        fields=fields, is_bigendian=False, point_step=48, row_step=48 * data.size // height,
        data=np.frombuffer(data.tobytes(), np.uint8),
    )  # fmt: skip
    connection = SimpleNamespace(topic="/ouster/points", msgtype="sensor_msgs/msg/PointCloud2")
    reader = SimpleNamespace(connections=[connection], messages=lambda connections: iter([(connection, 0, b"")]))
    convention = Convention("after", "nanoseconds after the header", 1e-9, 0.1)
    return SimpleNamespace(
        reader=reader, topic="/ouster/points", deserialize=lambda raw, kind: message, convention=convention
    )


@pytest.mark.parametrize("sense", [-1, 1])
def test_a_silent_beam_looked_where_its_ring_and_column_look(sense):
    look, points = sweep(sense)
    found, known = references.beam_directions(points, (points != 0).any(axis=2))
    assert known.all()
    np.testing.assert_allclose(found, look, atol=1e-6)


def test_a_ring_that_never_came_back_looks_nobody_knows_where():
    _, points = sweep()
    points[3] = 0.0
    assert (~references.beam_directions(points, (points != 0).any(axis=2))[1]).nonzero()[0].tolist() == [3] * COLUMNS


def test_a_sweep_keeps_every_beam_in_the_order_of_time():
    look, points = sweep()
    (scan,) = references.organised_scans(recording(points))
    reach = np.linalg.norm(scan.points, axis=1)
    silent = reach > 0.5 * references.SILENT_RANGE
    assert len(reach) == RINGS * COLUMNS
    assert silent.sum() == (points == 0).all(axis=2).sum()
    assert (np.diff(scan.times) >= 0).all()
    expected = look.transpose(1, 0, 2).reshape(-1, 3)
    np.testing.assert_allclose(scan.points[silent] / references.SILENT_RANGE, expected[silent], atol=1e-6)


def test_only_rings_by_columns_count_as_organised():
    _, points = sweep()
    assert references.is_organised(recording(points))
    assert not references.is_organised(recording(points, height=1))
