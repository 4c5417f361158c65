import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from benchmarks.command import BenchmarkError
from benchmarks.dirty.figures import judge_scene
from benchmarks.dirty.truth import Case, Truth, find_cases, load_truth
from benchmarks.dirty.verdict import (
    FAILED,
    MISLED,
    REFUSED,
    RIGHT,
    SILENT,
    VAGUE,
    WARNED,
    Fault,
    judge_build,
    list_faults,
    untold_faults,
)
from scene.judging.codes import Code

_ROW: dict[str, Any] = {"status": 0, "message": "", "from": 2.0, "to": 18.0, "reversed": False}
LENGTH, HALF, WALL = 20.0, 2.5, 2.5  # a straight arch 5 m wide and 5 m high


def outline(half: float = HALF, floor: float = 0.0) -> np.ndarray:
    """A closed section about the middle of its height, m; `floor` lifts its floor."""
    turn = np.linspace(0.0, np.pi, 37)
    crown = np.stack([half * np.cos(turn), half * np.sin(turn)], axis=1)
    sides = np.linspace(0.0, -WALL + floor, 9)[1:]
    left = np.stack([np.full(8, -half), sides], axis=1)
    bed = np.stack([np.linspace(-half, half, 21)[1:], np.full(20, -WALL + floor)], axis=1)
    right = np.stack([np.full(7, half), sides[::-1][1:]], axis=1)
    return np.concatenate([crown, left, bed, right])


def scene_folder(folder: Path, section: np.ndarray, length: float = LENGTH) -> Path:
    station = np.linspace(0.0, length, 81)
    around = np.stack(np.broadcast_arrays(station[:, None], section[:, 0], section[:, 1]), axis=-1)
    n, m = around.shape[:2]
    i, j = np.meshgrid(np.arange(n - 1), np.arange(m), indexing="ij")
    a, b, c, d = i * m + j, i * m + (j + 1) % m, (i + 1) * m + j, (i + 1) * m + (j + 1) % m
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    mesh = trimesh.Trimesh(around.reshape(-1, 3), faces, process=False)
    (folder / "meshes").mkdir(parents=True)
    for name in ("lining", "lining_smooth"):
        mesh.export(folder / "meshes" / f"{name}.ply")
    position = np.stack([station, 0 * station, 0 * station], axis=1)
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
    full = np.full(len(axis), 2.5)
    return Truth(axis, wall, (1.0, 19.0), full, 2 * full, 2 * full, "none", ends=(0.0, LENGTH), plain=True)


def test_a_scene_that_is_the_truth_has_no_errors(tmp_path: Path, truth: Truth) -> None:
    row = judge_scene(scene_folder(tmp_path / "scene", outline()), replace(truth, track="single"))
    assert row["wall_mean"] < 1e-6
    assert row["wall_near"] == 1.0
    for name in ("width", "height", "floor", "aside"):
        assert abs(row[f"{name}_worst"]) < 1e-6, name
    assert not list_faults(row, replace(truth, track="single"))
    assert judge_build({**row, "status": 0, "warnings": []}, [], truth) == RIGHT


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        ({"half": HALF + 0.05}, "width +10 cm"),
        ({"floor": 0.2}, "floor +20 cm"),
        ({"length": LENGTH + 1.0}, "1.00 m too long"),
        ({"length": LENGTH - 3.0}, "of the span built"),
        ({}, "1 sleepers where no track is"),
    ],
)
def test_each_fault_of_a_scene_is_named(tmp_path: Path, truth: Truth, spoil: dict, named: str) -> None:
    length = spoil.pop("length", LENGTH)
    row = judge_scene(scene_folder(tmp_path / "scene", outline(**spoil), length), truth)
    faults = [fault.text for fault in list_faults(row, truth)]
    assert any(named in fault for fault in faults), faults


def test_rough_walls_are_as_wide_as_they_stand_apart_and_no_wider(tmp_path: Path, truth: Truth) -> None:
    section = outline()
    rough = section.copy()
    rough[:, 0] *= 1.0 + 0.02 * np.cos(section[:, 1] * 2.0 * np.pi / 0.8)  # 5 cm in and out
    folder = scene_folder(tmp_path / "scene", rough)
    assert judge_scene(folder, truth)["width"] > 0.05  # its widest chord
    banded = replace(truth, band=(-1.7, -0.1))  # two waves
    assert abs(judge_scene(folder, banded)["width"]) < 0.02
    wide = judge_scene(scene_folder(tmp_path / "wide", outline(HALF + 0.05)), banded)
    assert abs(wide["width"] - 0.1) < 1e-6
    assert abs(wide["aside"]) < 1e-6


def test_an_axis_is_judged_by_where_the_true_walls_stand(tmp_path: Path, truth: Truth) -> None:
    moved = outline() + np.array([0.05, 0.0])  # both walls 5 cm further to the left
    folder = scene_folder(tmp_path / "scene", moved)
    assert abs(judge_scene(folder, truth)["aside"] - 0.05) < 1e-6
    assert abs(judge_scene(folder, replace(truth, middle=np.full(len(truth.axis), 0.05)))["aside"]) < 1e-6


def warning(code: str, start: float | None = None, end: float = 0.0, text: str = "") -> dict[str, Any]:
    return {"code": code, "text": text} | ({} if start is None else {"start": start, "end": end})


@pytest.mark.parametrize(
    ("fault", "said", "told"),
    [
        (Fault("floor", "floor -4 cm", 10.0), warning(Code.UNSEEN, 7.0, 9.0), True),
        (Fault("floor", "floor -4 cm", 10.0), warning(Code.UNSEEN, 12.0, 15.0), False),
        (Fault("floor", "floor -4 cm", 10.0), warning(Code.GRADE), False),
        (Fault("floor", "floor -4 cm", 10.0), warning(Code.AXES), True),
        (Fault("width", "width +9 cm", 10.0), warning(Code.PLACE, 8.0, 8.5), True),
        (Fault("walls", "walls 5.0 cm"), warning(Code.POSES), True),
        (Fault("sleepers", "no sleeper seen"), warning(Code.SLEEPERS), True),
        (Fault("sleepers", "no sleeper seen"), warning(Code.UNSEEN), False),
        (Fault("gauge", "gauge -33 mm"), warning(Code.ROUNDED), True),
        (Fault("gauge", "gauge -33 mm"), warning(Code.PLACE, 8.0, 8.5), False),
        (Fault("too long", "0.17 m too long"), warning(Code.CUT_SHORT, 15.0, 16.0), True),
        (Fault("too long", "0.17 m too long"), warning(Code.UNSEEN, 15.0, 16.0), False),
        (Fault("rings", "2 rings measured"), warning(Code.POSES), False),
        (Fault("pockets", "4 pockets by standard"), warning(Code.BY_STANDARD), True),
    ],
)
def test_a_warning_excuses_the_faults_of_its_code_at_its_place_and_no_other(
    truth: Truth, fault: Fault, said: dict, told: bool
) -> None:
    row = {**_ROW, "warnings": [said]}
    assert judge_build(row, [fault], truth) == (WARNED if told else VAGUE)
    assert untold_faults(row, [fault], truth) == ([] if told else [fault])
    assert judge_build({**row, "warnings": []}, [fault], truth) == SILENT


def test_a_known_trouble_excuses_the_shape_there_where_a_warning_names_its_cause_and_place(truth: Truth) -> None:
    truth = replace(truth, trouble=(12.0, 14.0), cause=("vehicle",))
    there, elsewhere, other = Fault("floor", "x", 13.0), Fault("floor", "x", 3.0), Fault("gauge", "x")
    said = warning(Code.BEYOND, 10.0, 12.0, "a vehicle hides the rest")
    row = {**_ROW, "warnings": [said]}
    assert judge_build(row, [there], truth) == WARNED
    assert untold_faults(row, [there, elsewhere, other], truth) == [elsewhere, other]
    for vague in ({**said, "text": "something is odd"}, {**said, "start": 0.5, "end": 1.0}):
        assert judge_build({**row, "warnings": [vague]}, [there], truth) == VAGUE
    assert judge_build({**row, "warnings": []}, [], replace(truth, must_say=True)) == SILENT
    assert judge_build(row, [], replace(truth, must_say=True)) == RIGHT


def test_a_scene_may_count_from_the_other_end(truth: Truth) -> None:
    fault, row = Fault("floor", "floor -4 cm", 4.0), {**_ROW, "warnings": [warning(Code.PLACE, 13.0, 15.0)]}
    assert judge_build(row, [fault], truth) == VAGUE
    assert judge_build({**row, "reversed": True}, [fault], truth) == WARNED


def test_a_refusal_must_name_the_cause_and_the_name_of_the_file_does_not_count(truth: Truth) -> None:
    truth = replace(truth, expect="refused", cause=("room",))
    row = {"status": 2, "warnings": []}
    assert judge_build({**row, "message": "error: out/room.laz: only 1.9 m long"}, [], truth) == MISLED
    assert judge_build({**row, "message": "error: out/room.laz: a room, not a tunnel"}, [], truth) == REFUSED
    assert judge_build({**row, "status": 1, "message": "ValueError: room"}, [], truth) == FAILED


def test_cases_are_found_with_their_arguments_and_missing_clouds_are_said(tmp_path: Path, truth: Truth) -> None:
    values = {"axis": truth.axis, "wall": truth.wall, "span": truth.span, "width": 5.0}
    np.savez(tmp_path / "arch-1_truth.npz", **values, arguments=["--control", "{folder}/prism.tum"], kind="late")
    with pytest.raises(BenchmarkError, match="no cloud arch-1"):
        find_cases(tmp_path)
    (tmp_path / "arch-1.ply").touch()
    (case,) = find_cases(tmp_path)
    assert case == Case("arch-1", tmp_path / "arch-1.ply", tmp_path / "arch-1_truth.npz", case.arguments, "late")
    assert case.words[-1] == str(tmp_path / "prism.tum")
    assert np.all(load_truth(case).width == 5.0)
    with pytest.raises(BenchmarkError, match="begins with road"):
        find_cases(tmp_path, ("road",))
