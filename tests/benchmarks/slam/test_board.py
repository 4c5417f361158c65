"""The arena's board: bounds along the dial, tables and figure, distances reached, mistakes."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.command import BenchmarkError
from benchmarks.records import read_records
from benchmarks.slam import board, board_page
from benchmarks.slam.__main__ import command
from benchmarks.slam.arena import bound, gate
from benchmarks.slam.arena.record import Course, draw_scene
from benchmarks.slam.score import reach_of
from tests.benchmarks.slam.tracks import line, write_axis, write_tum


def test_slopes_are_those_of_the_ranges_and_jumps_count_as_noise():
    shift = bound._PLACES
    slope, left = bound.fit_slopes(np.column_stack([3.0 - 0.4 * shift, np.where(shift > 0.0, 5.0, 4.0), 0.0 * shift]))
    np.testing.assert_allclose(slope[[0, 2]], [-0.4, 0.0], atol=1e-12)
    np.testing.assert_allclose(left[[0, 2]], 0.0, atol=1e-12)
    assert left[1] > 0.05


def test_the_dial_tells_more_the_rougher_the_walls(monkeypatch):
    monkeypatch.setattr(bound, "_SWEEPS", 2)
    found = {}
    for walls in ("smooth", "joints", "furnished"):
        scene = draw_scene(Course("one", walls, distance=10.0), np.random.SeedSequence(2))
        found[walls] = bound.find_floor(scene)
    assert found["smooth"].sweep > 3.0 * found["joints"].sweep
    assert found["joints"].sweep > 3.0 * found["furnished"].sweep
    one = found["joints"]
    sweeps = 10.0 * one.view / 1.5
    assert one.drift == pytest.approx(one.sweep * np.sqrt(2.0 / sweeps) * np.sqrt(100.0 / one.view))


def test_the_gate_is_shut_in_a_tube_open_in_a_room_and_opened_by_a_cloud_of_dust():
    rng = np.random.default_rng(0)
    angle, along = rng.uniform(0.0, 2.0 * np.pi, 6000), rng.uniform(-15.0, 15.0, 6000)
    tube = np.column_stack([along, 2.8 * np.cos(angle), 2.8 * np.sin(angle)])
    walls = rng.uniform(-1.0, 1.0, (6000, 3))
    walls[np.arange(6000), np.repeat([0, 1, 2], 2000)] = rng.choice([-1.0, 1.0], 6000)
    assert gate.least_eigenvalue(tube) < 1e-3
    assert gate.least_eigenvalue(4.0 * walls) == pytest.approx(1.0 / 3.0, abs=0.05)
    puffs = rng.standard_normal((6000, 3))
    puffs *= 1.5 / np.linalg.norm(puffs, axis=1, keepdims=True)
    assert gate.least_eigenvalue(np.concatenate([tube[:3000], puffs])) > 0.05
    with pytest.raises(ValueError, match="too few points"):
        gate.least_eigenvalue(tube[:5])


def test_the_gate_stays_open_in_the_dust_of_the_robot(monkeypatch):
    monkeypatch.setattr(gate, "_SWEEPS", 1)
    monkeypatch.setattr(gate, "_MERGED", 2)
    course = Course("one", "smooth", distance=10.0)
    clear, dusty = (
        gate.find_gate(draw_scene(one, np.random.SeedSequence(2))) for one in (course, replace(course, dust=1.0))
    )
    assert clear < 0.002
    assert dusty > 5.0 * clear


def test_a_program_reaches_as_far_as_its_error_stays_within_a_metre():
    travelled = np.arange(6.0)
    assert reach_of(travelled, np.array([0.0, 0.5, -0.9, -1.1, 0.0, 0.0])) == 3.0
    assert reach_of(travelled, np.zeros(6)) is None


@pytest.fixture
def sets(tmp_path: Path) -> list[Path]:
    """Two sets of two recordings without bags, and poses of a program that is 1 % and 3 % long and once missing."""
    for k, name in enumerate(("one", "two")):
        for recording in ("walls-smooth", "walls-sprayed"):
            truth = tmp_path / name / "truth" / recording
            time, position, turn = line()
            write_tum(truth / "lidar.tum", time, position, turn)
            write_axis(truth / "axis.csv", position)
            place = tmp_path / "poses" / name / "mine"
            write_tum(place / f"{recording}.tum", time, position * (1.01 + 0.02 * k), turn)
            failed = k == 1 and recording == "walls-smooth"
            facts = {"failed": "crashed"} if failed else {"poses": len(time), "seconds": 5.0, "share": 0.25}
            (place / f"{recording}.json").write_text(json.dumps(facts))
    return [tmp_path / "one", tmp_path / "two"]


def test_a_board_has_medians_over_the_sets_and_names_failures(sets, tmp_path):
    names = ("walls-smooth", "walls-sprayed")
    cases = [board.Case("mine", folder / "recordings" / name, tmp_path / "poses" / folder.name / "mine")
             for folder in sets for name in names]  # fmt: skip
    rows = [board._labels(one) | board.read_case(one) for one in cases]
    floors = [{"recording": name, "drift": 0.01, "gate": 0.002} for name in names]
    content = {"rows": rows, "floors": floors}
    assert board_page.median_drift(rows, "mine", "walls-smooth") is None
    assert board_page.median_drift(rows, "mine", "walls-sprayed") == pytest.approx((2.0, 1.0, 3.0), abs=1e-6)
    text = board_page.as_markdown(content)
    # 1 % of 100 m is 1 m and no more; 3 % exceed it from 33.5 m on.
    (line,) = [line for line in text.splitlines() if line.startswith("| mine")]
    assert line == "| mine | 4 | failed | 2.00 (1.00 to 3.00) | 0.000 | 34 (1/3) | 25 % |"
    assert "| *gate* | | 0.002 | 0.002 | | | |" in text
    assert "- mine on walls-smooth: crashed (two)" in text
    assert board_page.as_png(content).startswith(b"\x89PNG")


def test_runs_of_other_days_stand_on_the_board_beside_new_ones(sets, tmp_path):
    """Kept as a file of a row a run, which the page's table is written from; a run made again replaces its row."""
    old = {"set": "one", "recording": "walls-smooth", "program": "other", "version": "1.0", "date": "2026-01-02",
           "machine": "abacus", "drift": 100.0, "across_rms": 0.25, "reach": 4.0, "share": 0.5}  # fmt: skip
    crashed = {**{name: old[name] for name in ("set", "program")}, "recording": "walls-sprayed", "failed": "crashed"}
    redone = {**old, "program": "mine", "drift": 77.0}
    floors = [{"set": "one", "recording": name, "program": board.FLOOR, "drift": 0.01, "gate": 0.002}
              for name in ("walls-smooth", "walls-sprayed")]  # fmt: skip
    path = tmp_path / "runs.csv"
    path.write_text(board.runs_as_csv([old, crashed, redone, *floors]))
    place = tmp_path / "poses" / "one" / "mine"
    mine = board.Case("mine", sets[0] / "recordings" / "walls-smooth", place)
    every = board.merge_runs(board.read_runs(path), [board._labels(mine) | board.read_case(mine)])
    path.write_text(board.runs_as_csv(every))
    assert board.read_runs(path) == board.read_runs(path)
    rows = {(row["recording"], row["program"]): row for row in board.read_runs(path)}
    assert rows["walls-smooth", "other"] == old
    assert rows["walls-sprayed", "other"] == crashed
    assert rows["walls-smooth", "mine"]["drift"] == pytest.approx(1.0, abs=1e-6)
    out = tmp_path / "out"
    assert command(["board", "--runs", str(path), "--out", str(out)]) == 0
    table = (out / "board.md").read_text()
    assert table.endswith("- other on walls-sprayed: crashed (one)\n")
    assert "| other | 2 | 100 | failed | 0.250 | 4 (1/1) | 50 % |" in table
    found = {one.id: one.value for one in read_records(out / "records.json")}
    assert found["arena/other/smooth"] == 100.0
    assert "arena/other/sprayed" not in found, "a failure is no figure"
    assert found["arena/floor/smooth"] == 0.01
    assert json.loads((out / "board.json").read_text())["floors"][0]["gate"] == 0.002
    assert (out / "board.png").is_file()


def test_a_file_of_runs_that_is_none_is_refused_before_anything_runs(tmp_path, capsys):
    (tmp_path / "runs.csv").write_text("set,recording\none,walls-smooth\n")
    words = ["board", "--out", str(tmp_path / "out"), "--runs", str(tmp_path / "runs.csv")]
    assert command(words) == 2
    assert "runs.csv: not a file of runs, for its columns are others" in capsys.readouterr().err
    good = board.runs_as_csv([{"set": "one", "recording": "a", "program": "b", "drift": 1.0}])
    (tmp_path / "runs.csv").write_text(good.replace(",1,", ",one,"))
    assert command(words) == 2
    assert "runs.csv: not a file of runs (could not convert string to float: 'one')" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_half_a_trajectory_is_a_failure(sets, tmp_path):
    case = board.Case("mine", sets[0] / "recordings" / "walls-sprayed", tmp_path / "poses" / "one" / "mine")
    path = case.place / "walls-sprayed.tum"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:200]))
    assert board.read_case(case)["failed"].startswith("gives poses over 50 %")


def test_poses_are_scored_without_bags_and_what_was_not_run_is_left_out(sets, tmp_path, monkeypatch):
    monkeypatch.setitem(board.PROGRAMS, "mine", "no-such-package")
    for folder in sets:
        for name in ("walls-smooth", "walls-sprayed"):
            bag = folder / "recordings" / name / "recording"
            bag.mkdir(parents=True)
            (bag / "metadata.yaml").write_text("")
            (bag / "odometry.tum").write_bytes((folder / "truth" / name / "lidar.tum").read_bytes())
    (tmp_path / "poses" / "two" / "mine" / "walls-smooth.json").unlink()
    config = board.BoardConfig(tmp_path, tuple(sets), ("wheel-odometry", "mine"), run=False)
    cases = board.plan_board(config)
    assert [one.program for one in cases].count("mine") == 3
    assert all(board.read_case(one)["drift"] < 1e-6 for one in cases if one.program == "wheel-odometry")
    with pytest.raises(BenchmarkError, match="holds no poses of wheel-odometry, mine to score"):
        board.plan_board(board.BoardConfig(tmp_path / "other", tuple(sets), config.programs, run=False))
    with pytest.raises(BenchmarkError, match="needs no-such-package"):
        board.plan_board(board.BoardConfig(tmp_path, tuple(sets), config.programs))


@pytest.mark.parametrize(("words", "sentence"), [
    ({"sets": ()}, "must name at least one"), ({"jobs": 0}, "jobs must be at least 1"),
    ({"programs": ("moon",)}, "no program 'moon'; there are wheel-odometry"),
    ({"sets": (Path("a/x"), Path("b/x"))}, "differ in the last part"),
])  # fmt: skip
def test_wrong_settings_of_a_board_are_refused(tmp_path, words, sentence):
    settings = {"sets": (tmp_path,), "out": tmp_path / "o"} | words
    with pytest.raises(BenchmarkError, match=sentence):
        board.plan_board(board.BoardConfig(**settings))
