"""The truth of a simulated survey from its files, which are written here by independent code."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.references import TRUTH_SCHEMA, Truth, load_truth
from tests.benchmarks.fidelity import tube
from tests.benchmarks.fidelity.tube import Tube

HEAD = """ply
format binary_little_endian 1.0
element vertex {vertices}
property double x
property double y
property double z
element face {faces}
property list uchar int vertex_indices
property uchar part
end_header
"""
FACE = np.dtype([("count", "u1"), ("index", "<i4", 3), ("part", "u1")])


@pytest.fixture
def known() -> Truth:
    return tube.truth(Tube(length=6.0))


@pytest.fixture
def folder(known: Truth, tmp_path: Path) -> Path:
    surface = known.surface
    faces = np.zeros(len(surface.faces), FACE)
    faces["count"], faces["index"], faces["part"] = 3, surface.faces, known.part
    head = HEAD.format(vertices=len(surface.vertices), faces=len(faces)).encode()
    (tmp_path / "truth.ply").write_bytes(
        head + (surface.vertices + known.origin).astype("<f8").tobytes() + faces.tobytes()
    )
    columns = {name: getattr(known, name).tolist() for name in ("station", "tangent", "width", "height")}
    columns |= {"position": (known.position + known.origin).tolist(), "definitions": {"parts": list(known.parts)}}
    (tmp_path / "truth.json").write_text(json.dumps({"schema": TRUTH_SCHEMA, **columns, **known.furniture}))
    return tmp_path


def test_a_truth_is_read_as_it_was_written(known: Truth, folder: Path) -> None:
    read = load_truth(folder, known.origin)
    np.testing.assert_allclose(read.surface.vertices, known.surface.vertices, atol=1e-9)
    np.testing.assert_array_equal(read.surface.faces, known.surface.faces)
    np.testing.assert_array_equal(read.part, known.part)
    np.testing.assert_allclose(read.position, known.position, atol=1e-9)
    assert read.parts == known.parts
    assert read.furniture["rails"]["gauge"] == pytest.approx(1.435)


def test_a_truth_of_another_schema_is_refused(known: Truth, folder: Path) -> None:
    path = folder / "truth.json"
    path.write_text(path.read_text().replace(TRUTH_SCHEMA, "subterra.truth/0"))
    with pytest.raises(FidelityError, match=r"truth\.json: schema is subterra\.truth/0"):
        load_truth(folder, known.origin)


def test_a_folder_without_a_surface_has_no_truth(known: Truth, folder: Path) -> None:
    (folder / "truth.ply").unlink()
    with pytest.raises(FidelityError, match=r"holds no truth\.json with its truth\.ply"):
        load_truth(folder, known.origin)
