"""The arena's board, its bounds, records and figure; programs that fail and folders without anything to score."""

import json
import shutil
import sys
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from benchmarks.command import BenchmarkError
from benchmarks.slam import board, board_page, programs
from benchmarks.slam.__main__ import command
from benchmarks.slam.arena import bags, record
from benchmarks.slam.arena.record import Course, draw_scene
from benchmarks.slam.board_page import records_of
from benchmarks.slam.score import reach_of
from subterra_jax.evaluation.localisability import PLACES, fit_slopes
from tests.benchmarks.slam.tracks import line, write_axis, write_tum
from tests.recorded import check

VALUES = Path(__file__).with_name("values.csv")


def test_slopes_are_those_of_the_ranges_and_jumps_count_as_noise():
    shift = PLACES
    slope, left = fit_slopes(np.column_stack([3.0 - 0.4 * shift, np.where(shift > 0.0, 5.0, 4.0), 0.0 * shift]))
    np.testing.assert_allclose(slope[[0, 2]], [-0.4, 0.0], atol=1e-12)
    np.testing.assert_allclose(left[[0, 2]], 0.0, atol=1e-12)
    assert left[1] > 0.05


def test_the_dial_tells_more_the_rougher_the_walls(monkeypatch):
    monkeypatch.setattr(board, "_SWEEPS", 2)
    found = {}
    for walls, texture in (("smooth", 0.0), ("joints", 0.0), ("furnished", 0.0), ("sprayed", 1.0)):
        scene = draw_scene(Course("one", walls, distance=10.0, texture=texture), np.random.SeedSequence(2))
        found[walls] = board.find_floor(scene)
        check(VALUES, f"floor of {walls}", found[walls]._asdict(), rel=1e-3)
    assert found["smooth"].sweep > 3.0 * found["joints"].sweep
    assert found["joints"].sweep > 3.0 * found["furnished"].sweep
    one = found["joints"]
    sweeps = 10.0 * one.view / 1.5
    assert one.drift == pytest.approx(one.sweep * np.sqrt(2.0 / sweeps) * np.sqrt(100.0 / one.view))


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
    rows = [board.read_case(board.Case("mine", folder / "recordings" / name, tmp_path / "poses" / folder.name / "mine"))
            for folder in sets for name in names]  # fmt: skip
    assert {row["set"] for row in rows} == {"one", "two"}
    floors = [{"recording": name, "drift": 0.01} for name in names]
    facts = {"platform": "cpu", "cpu_cores": 2, "date": "2026-11-26T00:00", "commit": "abc"}
    content = {"rows": rows, "floors": floors, **facts}
    assert board_page.median_drift(rows, "mine", "walls-smooth") is None
    text = board_page.as_markdown(content)
    # 1 % of 100 m is 1 m and no more; 3 % exceed it from 33.5 m on.
    (line,) = [line for line in text.splitlines() if line.startswith("| mine")]
    assert line == "| mine | 4 | failed | 2.00 (1.00 to 3.00) | 0.000 | 34 (1/3) | 25 % |"
    assert "- mine on walls-smooth: crashed (two)" in text
    assert len(board_page.draw_board(content).axes) == 1
    found = {one.id: one for one in records_of(content)}
    assert set(found) == {"arena/mine/sprayed", "arena/floor/smooth", "arena/floor/sprayed"}, "a failure is no figure"
    assert found["arena/mine/sprayed"].interval == (1.0, 3.0)
    assert (found["arena/floor/smooth"].value, found["arena/floor/smooth"].commit) == (0.01, "abc")


def test_half_a_trajectory_is_a_failure(sets, tmp_path):
    case = board.Case("mine", sets[0] / "recordings" / "walls-sprayed", tmp_path / "poses" / "one" / "mine")
    path = case.place / "walls-sprayed.tum"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:200]))
    assert board.read_case(case)["failed"].startswith("gives poses over 50 %")


def test_the_odometer_is_taken_as_it_is(sets, tmp_path):
    one = sets[0] / "recordings" / "walls-smooth"
    write_tum(one / "recording" / "odometry.tum", *line())
    case = board.Case("wheel-odometry", one, tmp_path / "poses" / "one" / "wheel-odometry")
    assert board.read_case(case)["drift"] < 1e-6


def test_unknown_and_missing_programs_are_named(monkeypatch):
    with pytest.raises(BenchmarkError, match="no program 'fast'; there are wheel-odometry, evalio-kiss"):
        programs.find_program("fast")
    monkeypatch.setitem(programs.PROGRAMS, "absent", programs.Program("no-such-package", lambda at: None))
    with pytest.raises(BenchmarkError, match="absent needs no-such-package, which is not installed"):
        programs.find_program("absent")


@pytest.mark.parametrize(("poses", "reason"), [
    ((np.zeros(1), np.zeros((1, 4, 4)), 0.0), "gives 1 poses"),
    ((np.arange(3.0), np.full((3, 4, 4), np.nan), 0.0), "gives poses that are not finite"),
])  # fmt: skip
def test_a_program_that_gives_no_track_says_why(poses, reason, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(programs.PROGRAMS, "mine", programs.Program("jax", lambda at: poses))
    assert programs.main(["mine", str(tmp_path), str(tmp_path / "poses.tum")]) == 1
    assert capsys.readouterr().err == f"{reason}\n"
    assert not (tmp_path / "poses.tum").exists()


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    """A set with the beginning of one drive and its truth."""
    folder = tmp_path_factory.mktemp("slam") / "set"
    one = folder / "recordings" / "one"
    one.mkdir(parents=True)
    scene = record.draw_scene(record.Course("one", "smooth", distance=1.0), np.random.SeedSequence(4))
    for _ in bags.write_bags(one, ("mcap",), islice(record.stream(scene), 80)):
        pass
    (one / "calibration.yaml").write_text(yaml.safe_dump(record.calibration(scene)))
    record.write_truth(scene, folder / "truth" / "one")
    return folder


def _numbers(value):
    """All numbers of an argument; of times since 1970, s or ns, the last digits."""
    if isinstance(value, dict | list | tuple):
        rows = [_numbers(one) for one in (value.values() if isinstance(value, dict) else value)]
        return np.concatenate([*rows, np.zeros(0)])
    found = np.ravel(value).astype(float)
    return np.where(found > 1e17, found % 1e12, np.where(found > 1e9, found % 1e3, found))


@pytest.mark.parametrize("name", ["rko-lio", "se3-lio", "genz-lio", "pelorus"])
def test_a_program_is_fed_sweeps_and_imu_samples_in_order(name, drive, tmp_path, monkeypatch, capsys):
    calls, pose, stamps = {}, np.eye(4) + np.diag([0.25, 0.5], 2), iter(np.arange(1.5, 9.0))

    def note(call, answer=lambda: None):
        def called(*args, **options):
            for k, value in enumerate([*args, *options.values()]):
                calls.setdefault(f"{call} {k}", []).append(value)
            return answer()

        return called

    turned = {"orientation": (0.5, 0.5, 0.5, -0.5), "position": (1.0, 2.0, 3.0), "timestamp_nanosec": 5e8}
    answers = iter([None, *(turned | {"timestamp_sec": k} for k in (1, 2, 3))])
    program = SimpleNamespace(
        add_imu_measurement=note("sample"), pose=lambda: pose, lidar_pose=pose, add_imu=note("sample"),
        register_frame=note("sweep", lambda: (SimpleNamespace(stamp=next(stamps), pose=pose), None)),
        register_scan=note("sweep", lambda: SimpleNamespace(valid=True, timestamp=next(stamps))),
        add_pointcloud=note("sweep"), try_recv=lambda: next(answers),
    )  # fmt: skip
    settings = SimpleNamespace(mapping=SimpleNamespace())
    module = SimpleNamespace(
        LIOConfig=note("config"), LIO=lambda _: program, SE3LIO=note("config", lambda: program), Handle=lambda: program,
        Config=lambda: settings, GenZLIO=lambda _: program,
    )  # fmt: skip
    for one in ("rko_lio", "rko_lio.config", "rko_lio.lio", "se3_lio", "genz_lio", "pelorus"):
        monkeypatch.setitem(sys.modules, one, module)
    assert programs.main([name, str(drive / "recordings" / "one"), str(tmp_path / "poses.tum")]) == 0
    assert json.loads(capsys.readouterr().out)["poses"] == 3
    told = {call: _numbers([one for one in values if one is not None]) for call, values in calls.items()}
    told |= {"settings": str(settings), "poses": _numbers(np.loadtxt(tmp_path / "poses.tum"))}
    check(VALUES, f"program {name}", told)


def test_a_recording_must_be_whole_before_a_program_runs_on_it(drive, tmp_path, capsys):
    shutil.copytree(drive, tmp_path / "set")
    one, out = tmp_path / "set" / "recordings" / "one", tmp_path / "out"
    asked = ["board", "--sets", str(tmp_path / "set"), "--programs", "rko-lio", "--out", str(out)]

    def refused(sentence: str) -> None:
        assert command([*asked]) == 2
        output = capsys.readouterr().err
        assert sentence in output
        assert output.count("\n") == 1

    whole = (one / "calibration.yaml").read_text()
    for text, sentence in (
        ("{", "is no calibration"), ("lidar: 3", "is no calibration"),
        ("lidar: {topic: /moon}\nimu: {topic: /imu}\n", "has no topic /moon; it has /imu/data, /odom"),
    ):  # fmt: skip
        (one / "calibration.yaml").write_text(text)
        refused(sentence)
    (one / "calibration.yaml").unlink()
    refused("one/calibration.yaml: is missing")
    (one / "calibration.yaml").write_text(whole)
    data = (one / "recording" / "recording.mcap").read_bytes()
    (one / "recording" / "recording.mcap").write_bytes(data[: len(data) // 2])
    refused("one/recording: not a whole recording")
    (one / "recording" / "metadata.yaml").unlink()
    refused("is no recording: metadata.yaml is missing")
    assert not out.exists()


def test_a_folder_without_anything_to_score_is_refused(tmp_path, capsys):
    truth = write_tum(tmp_path / "truth" / "one" / "lidar.tum", *line())
    write_axis(truth.parent / "axis.csv", line()[1])
    mine = write_tum(tmp_path / "mine" / "one.tum", *line()).parent
    asked = ("--truth", str(tmp_path / "truth"))
    assert command(["score", "--estimate", str(mine), *asked, "--out", str(tmp_path / "scores")]) == 0
    assert (tmp_path / "scores" / "scores.md").read_text().count("| one | mine |") == 1
    assert command(["score", "--estimate", str(mine / "one.tum"), *asked]) == 0
    assert "warning" not in capsys.readouterr().err
    write_tum(truth.parent.parent / "two" / "lidar.tum", *line())
    write_tum(mine / "won.tum", *line())
    write_tum(mine / "one.tum", *line(541))
    assert command(["score", "--estimate", str(mine), *asked]) == 0
    output = [row for row in capsys.readouterr().err.splitlines() if row.startswith("warning")]
    assert ["14 s of poses" in output[0], "won.tum" in output[1], output[2].endswith("no poses of two")] == [True] * 3
    write_tum(tmp_path / "others" / "three.tum", *line())
    for given, sentence in ((tmp_path / "others", "holds no NAME.tum"), (tmp_path / "nobody", "no such file")):
        assert command(["score", "--estimate", str(given), *asked]) == 2
        assert sentence in capsys.readouterr().err
