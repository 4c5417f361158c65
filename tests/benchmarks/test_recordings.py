"""Conventions drawn at random: each is one that a driver can write, and its reading is judged against the truth."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import recordings
from benchmarks.recordings import Case, RecordingsConfig, draw_case, drive_through, read_case, write_case
from scene.survey.conventions import Convention


def test_every_kind_is_drawn_and_the_same_number_draws_the_same():
    cases = [draw_case(np.random.default_rng([0, k])) for k in range(300)]
    assert cases[7] == draw_case(np.random.default_rng([0, 7]))
    for case in cases:
        case.convention.check()
    for name, odds in recordings._ODDS.items():
        drawn = Counter(getattr(case.convention, name) for case in cases)
        assert set(drawn) == set(odds), name
    assert {case.beside for case in cases} == {"nothing", "trajectory", "IMU"}


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    whole = drive_through(RecordingsConfig(), folder)
    return folder, replace(whole, sweeps=whole.sweeps[90:150])


CASES = {
    "as its driver has it": (Case(Convention(), "nothing", 0.0), "as control"),
    "since boot, headers at the end, a trajectory that is late": (
        Case(Convention("boot", "ns", header_of="end", bags=2), "trajectory", 0.4), "as control"),
    "since boot, 32 bits, an IMU that is early": (
        Case(Convention("boot", "ns", "u4", imu_late=-0.3, container="mcap"), "IMU", -0.3), "as control"),
    "constant, beside a trajectory": (Case(Convention("constant"), "trajectory", 0.0), "static, as said"),
    "too many bad times": (Case(Convention("header", "us", bad_times=0.1), "nothing", 0.0), "refused, true reason"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_recording_is_read_as_it_was_written(drive, name):
    folder, one = drive
    case, outcome = CASES[name]
    row = read_case(one, case, write_case(one, case, folder / "a.bag"))
    assert row.outcome == outcome, row.said


@pytest.mark.slow
def test_a_lidar_before_the_mouth_that_meets_little_loses_nothing(tmp_path):
    whole = drive_through(RecordingsConfig(), tmp_path)
    one, case = replace(whole, sweeps=whole.sweeps[:60]), Case(Convention(), "nothing", 0.0)
    row = read_case(one, case, write_case(one, case, tmp_path / "a.bag"))
    assert row.outcome == "as control", row.said


@pytest.mark.slow
def test_a_reader_that_takes_ms_for_s_is_found_out(drive, monkeypatch):
    folder, one = drive
    case = Case(Convention("header", "ms"), "nothing", 0.0)
    path = write_case(one, case, folder / "a.bag")
    monkeypatch.setattr("scene.reading.times._UNITS", {"s": 1.0, "ms": 1.1e-3, "us": 1e-6, "ns": 1e-9})
    assert read_case(one, case, path).outcome == "wrong in silence"
