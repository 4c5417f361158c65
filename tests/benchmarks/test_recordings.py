"""Conventions drawn at random: each is one that a driver can write, and its reading is judged against the truth."""

import json
from collections import Counter
from contextlib import nullcontext
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import recordings
from benchmarks.recordings import Case, RecordingsConfig, Row, compare, draw_case, drive_through, read_case, write_case
from benchmarks.records import read_records
from scene.survey.cast import sweeps
from scene.survey.messages import Convention
from tests.recorded import check, lines_of
from tests.scene.conftest import arc_bore

VALUES = Path(__file__).with_name("values.csv")
PLAIN = Case(Convention(), "avia", "trajectory", 0.0)


def test_every_kind_is_drawn_and_the_same_number_draws_the_same():
    cases = [draw_case(np.random.default_rng([0, k])) for k in range(300)]
    assert cases[7] == draw_case(np.random.default_rng([0, 7]))
    for case in cases:
        case.convention.check()
    counts = {name: Counter(str(getattr(case.convention, name)) for case in cases) for name in recordings._ODDS}
    for name, odds in recordings._ODDS.items():
        assert set(counts[name]) == set(map(str, odds)), name
    counts["beside"] = Counter(f"{case.sensor} {case.beside}" for case in cases)
    lates = [case.late for case in cases if case.late > -2.0]
    check(VALUES, "draws of conventions", {"counts": json.dumps(counts, sort_keys=True), "late": lates})
    assert {case.late for case in cases if case.late < -2.0} == {-2e8}


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """The first 6 s of a VLP-16, most of them before the mouth, and 6 s of an Avia further in."""
    folder = tmp_path_factory.mktemp("drive")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recordings, "sweeps", lambda *given: islice(sweeps(*given), 60))
        first = drive_through(RecordingsConfig(), folder, "vlp16")
    whole = drive_through(RecordingsConfig(length=1.0), folder, "avia")
    return folder, {"vlp16": first, "avia": replace(whole, sweeps=whole.sweeps[90:150])}


def test_a_drive_has_a_sixth_of_the_firings_and_poses_at_the_times_of_its_points(drives):
    for name, one in drives[1].items():
        seen, offset = one.sweeps[-1], one.lidar.offset
        assert len(offset) == len(seen.points) == {"vlp16": 28_800 // 6, "avia": 6000}[name]
        np.testing.assert_array_equal(np.sort(seen.offset), np.sort(offset))
        told = {"points": seen.points[seen.valid], "poses": one.poses.positions, "times": one.poses.times}
        check(VALUES, f"drive of {name}", told | {"prism": np.loadtxt(one.prism)}, rel=1e-3)


CASES = {
    "since boot, headers at the end, a trajectory that is late": (
        Case(Convention("boot", "ns", header_of="end", bags=2), "vlp16", "trajectory", 0.4), "as control"),
    "since boot, 32 bits, an IMU that is early": (
        Case(Convention("boot", "ns", "u4", imu_late=-0.3, container="mcap"), "vlp16", "IMU", -0.3), "as control"),
    "constant, beside a trajectory": (Case(Convention("constant"), "vlp16", "trajectory", 0.0), "static, as said"),
    "too many bad times": (
        Case(Convention("header", "us", bad_times=0.1), "avia", "trajectory", 0.0), "refused, true reason"),
    "some bad times": (Case(Convention("header", "us", bad_times=0.03), "avia", "trajectory", 0.0), "as control"),
    "half sweeps of a Livox, NaN where nothing came back": (
        Case(Convention("epoch", "ns", empty="nan", chunks=2, missing=0.02), "avia", "trajectory", 0.0), "as control"),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_recording_is_read_as_it_was_written(drives, name):
    folder, known = drives
    case, outcome = CASES[name]
    one = known[case.sensor]
    row = read_case(one, case, write_case(one, case, folder / "a.bag"))
    assert row.outcome == outcome, row.said


def test_a_reader_that_takes_ms_for_s_or_loses_points_is_found_out(drives, monkeypatch):
    folder, one = drives[0], replace(drives[1]["avia"], sweeps=drives[1]["avia"].sweeps[:20])
    path = write_case(one, case := replace(PLAIN, convention=Convention("header", "ms")), folder / "a.bag")
    monkeypatch.setattr("scene.reading.times._UNITS", {"s": 1.0, "ms": 0.7e-3, "us": 1e-6, "ns": 1e-9})
    assert read_case(one, case, path).outcome == "wrong in silence"
    monkeypatch.undo()
    more = replace(one, sweeps=[*one.sweeps, one.sweeps[-1]])
    assert read_case(more, case, path).outcome == "wrong in silence"
    assert read_case(replace(one, sweeps=one.sweeps[1:]), case, path).outcome == "wrong in silence", "unknown points"


def test_bores_are_compared_where_both_have_walls():
    bore = arc_bore()
    assert compare(bore, bore) == (0.0, 0.0)
    at = (bore.station >= 1.0) & (bore.station <= bore.length - 1.0)
    apart, longer = compare(bore, replace(bore, radius=1.01 * bore.radius))
    assert apart == pytest.approx(0.01 * np.sqrt(np.mean(bore.radius[at] ** 2)), rel=1e-3)
    assert longer == 0.0


@pytest.mark.parametrize(("read", "thicker", "longer", "said", "outcome"), [
    ("as control", 0.014, 0.0, "", "as control"), ("as control", 0.016, 0.0, "", "wrong in silence"),
    ("as control", 0.0, 0.09, "", "as control"), ("as control", 0.0, 0.11, "the clock", "other, with a warning"),
    ("wrong in silence", 0.0, 0.0, "no poses", "other, with a warning"),
    ("static, as said", 0.0, 9.0, "", "static, as said"), ("as control", None, 0.0, "", "refused, other reason"),
])  # fmt: skip
def test_a_bore_is_the_controls_within_15_mm_and_10_cm(read, thicker, longer, said, outcome, monkeypatch):
    control = arc_bore()

    def build(*_):
        station = control.station * (1.0 + longer / control.length)
        return replace(control, radius=control.radius + thicker, station=station), said

    monkeypatch.setattr(recordings, "read_case", lambda drive, case, path: Row(case, read, "header", "said"))
    monkeypatch.setattr(recordings, "build_case", build)
    drive = SimpleNamespace(controls={"trajectory": control})
    row = recordings.judge_case(drive, PLAIN, Path("a.bag"))
    assert row.outcome == outcome
    assert row.apart == pytest.approx(thicker or 0.0)


def test_a_run_counts_outcomes_by_kind_and_writes_rows_and_records(tmp_path, monkeypatch, capsys):
    rows = iter(
        [("as control", 1e-3), ("as control", 4e-3), ("refused, true reason", 0.0), ("wrong in silence", 0.1)] * 6
    )

    def judge(drive, case, path):
        outcome, apart = next(rows)
        return Row(case, outcome, "header", f"{drive} {path.name}", apart)

    def write(drive, case, path):
        path.write_text(drive)
        return path

    pool = nullcontext(SimpleNamespace(map=map))
    for name, value in {
        "ProcessPoolExecutor": lambda *_: pool, "drive_through": lambda config, folder, sensor: SimpleNamespace(
            controls={}, sensor=sensor), "_control": lambda sensor, beside, folder: f"{sensor} {beside}",
        "write_case": lambda drive, case, path: write(drive.sensor, case, path),
        "judge_case": lambda drive, case, path: judge(drive.controls[case.beside], case, path),
    }.items():  # fmt: skip
        monkeypatch.setattr(recordings, name, value)
    assert recordings.run(RecordingsConfig(count=24, out=tmp_path)) == 1
    printed = capsys.readouterr().out
    kept = [json.loads(line) for line in (tmp_path / "rows.jsonl").read_text().splitlines()]
    assert [row["number"] for row in kept] == list(range(24))
    assert all(row["said"] == f"{row['case']['sensor']} {row['case']['beside']} {row['number']}.bag" for row in kept)
    assert printed.count("wrong in silence: ") == 6
    records = read_records(tmp_path / "records.json")
    check(VALUES, "run of recordings", {"records": lines_of(records), "table": printed[printed.index("| kind") :]})
