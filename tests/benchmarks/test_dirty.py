"""The judge of built clouds: figures against a known truth, faults, what a warning excuses, verdicts, cases."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks import dirty
from benchmarks.command import BenchmarkError, Ran
from benchmarks.dirty import RIGHT, SILENT, VAGUE, WARNED, Fault, Truth, judge_build, judge_scene, list_faults
from scene.errors import Code
from tests.recorded import check

ROW: dict[str, Any] = {"status": 0, "message": "", "from": 2.0, "to": 18.0, "reversed": False}
PLAIN = Rotation.identity()
EXCUSES = Path(__file__).with_name("excuses.txt").read_text().splitlines()[1:]
VALUES = Path(__file__).with_name("values.csv")
LENGTH, HALF, WALL = 20.0, 2.5, 2.5  # a straight arch 5 m wide and 5 m high


def outline(half: float = HALF, floor: float = 0.0, aside: float = 0.0) -> np.ndarray:
    """A closed section about the middle of its height, m; `floor` lifts its floor, `aside` moves it to the left."""
    turn = np.linspace(0.0, np.pi, 37)
    crown = np.stack([half * np.cos(turn), half * np.sin(turn)], axis=1)
    sides = np.linspace(0.0, -WALL + floor, 9)[1:]
    left = np.stack([np.full(8, -half), sides], axis=1)
    bed = np.stack([np.linspace(-half, half, 21)[1:], np.full(20, -WALL + floor)], axis=1)
    right = np.stack([np.full(7, half), sides[::-1][1:]], axis=1)
    return np.concatenate([crown, left, bed, right]) + np.array([aside, 0.0])


def scene_folder(folder: Path, section: np.ndarray, length: float = LENGTH, turn: Rotation = PLAIN) -> Path:
    station = np.linspace(0.0, length, 81)
    around = np.stack(np.broadcast_arrays(station[:, None], section[:, 0], section[:, 1]), axis=-1)
    n, m = around.shape[:2]
    i, j = np.meshgrid(np.arange(n - 1), np.arange(m), indexing="ij")
    a, b, c, d = i * m + j, i * m + (j + 1) % m, (i + 1) * m + j, (i + 1) * m + (j + 1) % m
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    mesh = trimesh.Trimesh(turn.apply(around.reshape(-1, 3)), faces, process=False)
    (folder / "meshes").mkdir(parents=True)
    for name in ("lining", "lining_smooth"):
        mesh.export(folder / "meshes" / f"{name}.ply")
    position = turn.apply(np.stack([station, 0 * station, 0 * station], axis=1))
    np.savez(folder / "bore.npz", station=station, position=position, filled=np.zeros(81, bool))
    (folder / "manifest.json").write_text(json.dumps({"frame": {"origin": [1000.0, 0.0, 0.0]}}))
    (folder / "scene.xml").write_text('<m><geom name="sleeper_0" pos="3 0 0"/></m>')
    return folder


@pytest.fixture
def truth() -> Truth:
    station = np.arange(0.0, LENGTH + 0.01, 0.25)
    axis = np.stack([1000.0 + station, 0 * station, 0 * station], axis=1)
    section = outline()[:37]
    at, k = np.meshgrid(np.arange(1.0, 19.0), np.arange(len(section)), indexing="ij")
    wall = np.stack([1000.0 + at.ravel(), *section[k.ravel()].T], axis=1)
    full = np.where((station < 1.0) | (station > 19.0), 9.0, 2.5)  # outside the judged span anything
    return Truth(axis, wall, (1.0, 19.0), full, 2 * full, 2 * full, np.array([[1003.0, 0.0, -2.5]]))


def test_a_scene_that_is_the_truth_has_no_errors(tmp_path: Path, truth: Truth) -> None:
    row = judge_scene(scene_folder(tmp_path / "scene", outline()), truth)
    assert row["wall_mean"] < 1e-6
    assert (row["wall_near"], row["sleeper_f1"], row["reversed"]) == (1.0, 1.0, False)
    for name in ("width", "height", "floor", "aside"):
        assert abs(row[f"{name}_worst"]) < 1e-6, name
    assert not list_faults(row)
    assert judge_build({**row, "status": 0, "warnings": []}, []) == RIGHT


@pytest.mark.parametrize(("what", "amount", "named"), [
    ("half", HALF + 0.05, "width +10 cm"), ("half", HALF + 0.05, "walls 5.0 cm in the mean"),
    ("floor", 0.2, "floor +20 cm"), ("aside", 0.05, "aside +5 cm"), ("length", LENGTH - 3.0, "of the span built"),
    ("sleeper", 1.0, "sleeper F1 0.00"),
])  # fmt: skip
def test_each_fault_of_a_scene_is_named(tmp_path: Path, truth: Truth, what: str, amount: float, named: str) -> None:
    section = outline(**({what: amount} if what in ("half", "floor", "aside") else {}))
    folder = scene_folder(tmp_path / "scene", section, amount if what == "length" else LENGTH)
    moved = replace(truth, sleepers=truth.sleepers + np.array([amount * (what == "sleeper"), 0.0, 0.0]))
    faults = [fault.text for fault in list_faults(judge_scene(folder, moved))]
    assert any(named in fault for fault in faults), faults


@pytest.mark.parametrize("yaw", [0.0, 2.5])
def test_figures_of_a_spoiled_scene_are_those_of_the_table_whichever_way_it_lies(
    tmp_path: Path, truth: Truth, yaw: float
) -> None:
    turn = Rotation.from_euler("z", yaw)
    origin = np.array([1000.0, 0.0, 0.0])
    about = lambda points: turn.apply(points - origin) + origin  # noqa: E731
    station = truth.station
    turned = replace(
        truth, axis=about(truth.axis), wall=about(truth.wall), sleepers=None, span=(1.5, 18.9),
        axis_above_floor=2.5 + 0.01 * station, height=np.where(station < 9.0, np.nan, 5.0 + 0.02 * station),
        width=np.where(station > 16.0, np.nan, 5.0 - 0.003 * station),
    )  # fmt: skip
    folder = scene_folder(tmp_path / "scene", outline(HALF + 0.04, 0.2, 0.06), LENGTH - 3.0, turn)
    row = judge_scene(folder, turned)
    faults = [fault.text for fault in list_faults(row) if fault.kind != "aside"]
    del row["aside_worst_at"]  # it is off by the same everywhere
    check(VALUES, "spoiled scene", row | {"faults": faults})


def test_tolerances_are_3_cm_and_97_percent_and_sleepers_of_9_in_10() -> None:
    sound = dict.fromkeys(("width_worst", "height_worst", "floor_worst", "aside_worst", "wall_mean"), 0.0299)
    sound |= {"wall_near": 0.9701, "covered": 0.9701, "sleeper_f1": 0.9001}
    sound |= {f"{name}_worst_at": 3.0 for name in ("width", "height", "floor", "aside")}
    assert list_faults(sound) == []
    for name, value in sound.items():
        if not name.endswith("_at"):
            assert len(list_faults(sound | {name: value + (0.0002 if value < 0.5 else -0.0002)})) == 1, name


def warning(code: str, start: float | None = None, end: float = 0.0) -> dict[str, Any]:
    return {"code": code, "text": ""} | ({} if start is None else {"start": start, "end": end})


@pytest.mark.parametrize("row", EXCUSES)
def test_a_warning_excuses_the_faults_of_its_code_within_2_m_and_no_other(row: str) -> None:
    kind, place, code, start, end, warned = row.split()
    said = warning(Code[code], *(() if start == "-" else (float(start), float(end))))
    fault = Fault(kind.replace("-", " "), "x", float(place))
    assert judge_build({**ROW, "warnings": [said]}, [fault]) == (WARNED if warned == "yes" else VAGUE)
    assert judge_build({**ROW, "warnings": []}, [fault]) == SILENT


def test_a_scene_may_count_from_the_other_end() -> None:
    fault, row = Fault("floor", "floor -4 cm", 4.0), {**ROW, "warnings": [warning(Code.PLACE, 13.0, 15.0)]}
    assert judge_build(row, [fault]) == VAGUE
    assert judge_build({**row, "reversed": True}, [fault]) == WARNED


def test_cases_are_found_built_once_and_judged(tmp_path: Path, truth: Truth, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, out, built = tmp_path / "set", tmp_path / "out", []
    folder.mkdir()
    values = {"axis": truth.axis, "wall": truth.wall, "span": truth.span, "width": 5.0}
    for name in ("arch", "bent", "room"):
        np.savez(folder / f"{name}_truth.npz", **values)
    with pytest.raises(BenchmarkError, match="no cloud arch"):
        dirty.find_cases(folder)
    for name in ("arch", "bent", "room"):
        (folder / f"{name}.ply").touch()
    with pytest.raises(BenchmarkError, match="begins with road"):
        dirty.find_cases(folder, ("road",))
    np.savez(folder / "bent_truth.npz", axis=truth.axis)
    with pytest.raises(BenchmarkError, match=r"bent_truth\.npz: has no span and no wall"):
        dirty.load_truth(folder / "bent_truth.npz")

    def build(module: str, source: Path, _: str, scene: Path, *words: object, log: Path) -> Ran:
        built.append((module, *words))
        if source.stem == "room":
            return Ran(2, "error: a room", 1.0)
        scene_folder(scene, outline())
        return Ran(0, "", 1.0)

    monkeypatch.setattr(dirty, "run_module", build)
    for _ in range(2):
        words = [str(folder), "--out", str(out), "--only", "arch", "room", "--flags=--fast yes"]
        assert dirty.main(words) == 0
    assert built == [("scene.build", "--fast", "yes")] * 2, "what is there was built again"
    rows = {path.stem: json.loads(path.read_text()) for path in (out / "rows").iterdir()}
    assert {name: row["verdict"] for name, row in rows.items()} == {"arch": "right", "room": "refused"}
    check(VALUES, "page of builds", {"page": (out / "dirty.md").read_text()})
    assert not (out / "scenes" / "arch").exists()
    found = {one["id"]: (one["value"], one["n"]) for one in json.loads((out / "records.json").read_text())["records"]}
    assert found == {"dirty/wall-mean": (0.0, 1), "dirty/wall-within-10-cm": (100.0, 1)}
