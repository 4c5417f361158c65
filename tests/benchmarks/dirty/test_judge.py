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
    SILENT,
    VAGUE,
    WARNED,
    judge_row,
    list_faults,
    untold_faults,
)

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
    assert any(named in fault for fault in list_faults(row, truth)), list_faults(row, truth)


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


def test_a_wrong_scene_needs_a_warning_that_names_place_and_cause(truth: Truth) -> None:
    truth = replace(truth, trouble=(12.0, 14.0), cause=("vehicle",))
    row = {**_ROW, "faults": ["floor +70 cm"]}
    said = "a vehicle hides the floor from 12.5 to 13.9 m"
    assert judge_row({**row, "warnings": []}, truth) == SILENT
    assert judge_row({**row, "warnings": ["something is odd"]}, truth) == VAGUE
    assert judge_row({**row, "warnings": ["a vehicle hides the floor from 0.5 to 1.0 m"]}, truth) == VAGUE
    assert judge_row({**row, "warnings": [said]}, truth) == WARNED


@pytest.mark.parametrize(
    ("fault", "warning", "told"),
    [
        ("floor -4 cm at 10 m", "from 7 to 9 m hardly a return lies on the floor (40% of the girth)", True),
        ("floor -4 cm at 10 m", "from 12 to 15 m hardly a return lies on the floor (40% of the girth)", False),
        ("floor -4 cm at 10 m", "from 7 to 9 m hardly a return lies on the crown (40% of the girth)", False),
        ("width +9 cm at 10 m", "from 7 to 9 m, floor: 9% of the returns there are not the wall that was built", False),
        ("width +9 cm at 10 m", "from 7 to 9 m, left wall: 9% inside it: something along the wall", True),
        ("floor -4 cm at 10 m", "from 7 to 9 m, left wall: 9% inside it: a box on the floor", False),
        ("no sleeper seen", "3 sleepers lie where a spacing of 0.60 m asks for them, and none of them was seen", True),
        ("no sleeper seen", "from 7 to 9 m hardly a return lies on the crown (40% of the girth)", False),
        ("gauge -33 mm", "from 7 to 9 m, floor: 9% of the returns there are not the wall that was built", False),
        ("0.17 m too long", "from 15 to 16 m hardly a return lies on the crown (40% of the girth)", False),
        ("90.0 % within 10 cm", "11% of the returns lie further than 10 cm from the tunnel that was built", True),
        ("floor -4 cm at 10 m", "the bore climbs at up to 30%: is z up (--axes)?", True),
    ],
)
def test_a_warning_excuses_the_fault_that_it_speaks_of_and_no_other(
    truth: Truth, fault: str, warning: str, told: bool
) -> None:
    row = {**_ROW, "faults": [fault], "warnings": [warning]}
    assert judge_row(row, truth) == (WARNED if told else VAGUE)
    assert untold_faults(row, truth) == ([] if told else [fault])
    both = {**row, "faults": [fault, "2 rings measured that do not exist"]}
    assert "2 rings measured that do not exist" in untold_faults(both, truth)


_BLUR = "the poses blur the walls: 20 mm thick where a single sweep has 10 mm; {}"
_UNKNOWN = _BLUR.format("the poses, their clock or the mount of the LiDAR may be wrong")
_CLOCK = _BLUR.format("with the poses 0.1 s later they are thin: two clocks differ")
_TWICE = "from 5 to 15 m the wall shows twice, up to 7 cm apart, at 60% of its places: two passes do not fit"


@pytest.mark.parametrize(
    ("warning", "told", "untold"),
    [
        (_UNKNOWN, ("walls 5.0 cm in the mean", "floor -4 cm at 10 m", "gauge -33 mm", "no sleeper seen"),
         ("width +83 cm at 10 m", "92.0 % within 10 cm", "0.40 m too long", "45 rings measured that do not exist")),
        (_CLOCK, ("width +83 cm at 10 m", "92.0 % within 10 cm"),
         ("0.40 m too long", "only 80 % of the span built", "26 pockets measured that do not exist")),
        (_TWICE, ("width +12 cm at 10 m", "walls 4.0 cm in the mean"),
         ("width +12 cm at 2 m", "width +40 cm at 10 m", "0.40 m too long")),
        ("--control came without --calibration: all is off", ("aside +33 cm at 10 m", "height -9 cm at 4 m"),
         ("no sleeper seen", "3 rings measured that do not exist")),
        ("the coordinates of the cloud are rounded to 3.0 cm", ("floor +5 cm at 10 m",), ("floor +7 cm at 10 m",)),
        ("nothing measured the length: along smooth walls LiDAR odometry does not", ("0.40 m too long",),
         ("width +9 cm at 10 m", "walls 5.0 cm in the mean")),
        ("from 0 to 18 m floor and walls lean together by 2.0°, left side up", ("height +9 cm at 4 m",),
         ("height +40 cm at 4 m", "gauge -33 mm")),
        ("it would be 18 m wide: --unit ft makes it 5.5 m by 5.4 m", ("width +900 cm at 9 m", "30.00 m too long"),
         ("4 pockets measured that do not exist",)),
    ],
)  # fmt: skip
def test_a_cause_without_a_place_excuses_what_it_can_do_and_no_more(
    truth: Truth, warning: str, told: tuple[str, ...], untold: tuple[str, ...]
) -> None:
    row = {**_ROW, "faults": [*told, *untold], "warnings": [warning]}
    assert untold_faults(row, truth) == list(untold)
    assert judge_row({**row, "faults": list(told)}, truth) == WARNED
    assert all(judge_row({**row, "faults": [fault]}, truth) == VAGUE for fault in untold)
    known = replace(truth, cause=tuple(warning.split()[:2]))  # a trouble of the whole cloud excuses no more than that
    assert untold_faults(row, known) == list(untold)


def test_a_known_trouble_excuses_the_shape_there_and_nothing_else(truth: Truth) -> None:
    truth = replace(truth, trouble=(12.0, 14.0), cause=("vehicle",))
    row = {**_ROW, "warnings": ["a vehicle hides the rest, from 10 to 12 m"]}
    for fault in ("45 rings measured that do not exist", "0.40 m too long", "gauge -33 mm", "no sleeper seen"):
        assert untold_faults({**row, "faults": [fault, "walls 4.0 cm in the mean"]}, truth) == [fault]


def test_a_scene_may_count_from_the_other_end(truth: Truth) -> None:
    row = {**_ROW, "faults": ["floor -4 cm at 4 m"], "warnings": ["from 13 to 15 m, floor: 9% of the returns"]}
    assert judge_row(row, truth) == VAGUE
    assert judge_row({**row, "reversed": True}, truth) == WARNED
    assert not untold_faults({key: value for key, value in row.items() if key != "reversed"})  # rows of before


def test_a_known_trouble_excuses_no_fault_elsewhere(truth: Truth) -> None:
    truth = replace(truth, trouble=(12.0, 14.0), cause=("vehicle",))
    row = {**_ROW, "warnings": ["a vehicle hides the rest, from 10 to 12 m"]}
    assert judge_row({**row, "faults": ["floor +70 cm at 13 m"]}, truth) == WARNED
    assert judge_row({**row, "faults": ["floor +70 cm at 13 m", "floor +70 cm at 3 m"]}, truth) == VAGUE
    row["warnings"] = ["a vehicle stands in the bore at 1 m", "from 10 to 12 m the pipes were cut"]
    assert judge_row({**row, "faults": ["floor +70 cm at 13 m"]}, truth) == VAGUE  # cause here, place there


def test_a_refusal_must_name_the_cause_and_the_name_of_the_file_does_not_count(truth: Truth) -> None:
    truth = replace(truth, expect="refused", cause=("room",))
    row = {"status": 2, "faults": [], "warnings": []}
    assert judge_row({**row, "message": "error: out/room.laz: only 1.9 m long"}, truth) == MISLED
    assert judge_row({**row, "message": "error: out/room.laz: a room, not a tunnel"}, truth) == REFUSED
    assert judge_row({**row, "status": 1, "message": "ValueError: room"}, truth) == FAILED


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
