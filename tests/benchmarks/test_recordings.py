"""Conventions drawn at random: each is one that a driver can write, and its reading is judged against the truth."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import recordings
from benchmarks.recordings import Case, RecordingsConfig, compare, draw_case, drive_through, read_case, write_case
from scene.survey.messages import Convention
from tests.scene.conftest import arc_bore


def test_every_kind_is_drawn_and_the_same_number_draws_the_same():
    cases = [draw_case(np.random.default_rng([0, k])) for k in range(300)]
    assert cases[7] == draw_case(np.random.default_rng([0, 7]))
    for case in cases:
        case.convention.check()
    for name, odds in recordings._ODDS.items():
        drawn = Counter(getattr(case.convention, name) for case in cases)
        assert set(drawn) == set(odds), name
    assert {(case.sensor, case.beside) for case in cases} == {
        (sensor, beside) for sensor in ("vlp16", "avia") for beside in ("trajectory", "IMU")
    }


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    wholes = [drive_through(RecordingsConfig(), folder, sensor) for sensor in ("vlp16", "avia")]
    return folder, {one.sensor: replace(one, sweeps=one.sweeps[90:150]) for one in wholes}


CASES = {
    "since boot, headers at the end, a trajectory that is late": (
        Case(Convention("boot", "ns", header_of="end", bags=2), "vlp16", "trajectory", 0.4), "as control"),
    "since boot, 32 bits, an IMU that is early": (
        Case(Convention("boot", "ns", "u4", imu_late=-0.3, container="mcap"), "vlp16", "IMU", -0.3), "as control"),
    "constant, beside a trajectory": (Case(Convention("constant"), "vlp16", "trajectory", 0.0), "static, as said"),
    "too many bad times": (
        Case(Convention("header", "us", bad_times=0.1), "vlp16", "trajectory", 0.0), "refused, true reason"),
    "half sweeps of a Livox, NaN where nothing came back": (
        Case(Convention("epoch", "ns", empty="nan", pieces=2, missing=0.02), "avia", "trajectory", 0.0), "as control"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_recording_is_read_as_it_was_written(drives, name):
    folder, known = drives
    case, outcome = CASES[name]
    one = known[case.sensor]
    row = read_case(one, case, write_case(one, case, folder / "a.bag"))
    assert row.outcome == outcome, row.said


@pytest.mark.slow
def test_a_lidar_before_the_mouth_that_meets_little_loses_nothing(tmp_path):
    whole = drive_through(RecordingsConfig(), tmp_path, "vlp16")
    one, case = replace(whole, sweeps=whole.sweeps[:60]), Case(Convention(), "vlp16", "trajectory", 0.0)
    row = read_case(one, case, write_case(one, case, tmp_path / "a.bag"))
    assert row.outcome == "as control", row.said


@pytest.mark.slow
def test_a_reader_that_takes_ms_for_s_is_found_out(drives, monkeypatch):
    folder, one = drives[0], drives[1]["vlp16"]
    case = Case(Convention("header", "ms"), "vlp16", "trajectory", 0.0)
    path = write_case(one, case, folder / "a.bag")
    monkeypatch.setattr("scene.reading.times._UNITS", {"s": 1.0, "ms": 0.7e-3, "us": 1e-6, "ns": 1e-9})
    assert read_case(one, case, path).outcome == "wrong in silence"


def test_bores_are_compared_where_both_have_walls():
    bore = arc_bore()
    assert compare(bore, bore) == (0.0, 0.0)
    assert compare(bore, replace(bore, radius=1.01 * bore.radius))[0] > 0.02
