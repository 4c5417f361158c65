"""Every convention of point times is read as the same drive, or refused for its true reason."""

import numpy as np
import pytest

from benchmarks.rewrite import RewriteConfig, rewrite
from scene.errors import RecordingError
from scene.reading.recording import Recording
from scene.reading.times import Scan, TimeConfig
from scene.survey.messages import Convention
from tests.scene.conventions import sweeps, write_convention
from tests.scene.messages import pointcloud2, write_bag1


def read(path, **given) -> tuple[list[Scan], dict]:
    with Recording(path, times=TimeConfig(**given)) as recording:
        return list(recording.scans()), recording.facts


def agree(scans: list[Scan], late: float = 0.0) -> None:
    """As they were written: each start, each time, each point."""
    assert len(scans) == 12
    for scan, (start, points, offset) in zip(scans, sweeps(12), strict=True):
        assert scan.stamp == pytest.approx(start + late, abs=2e-4)
        assert len(scan.points) > 0.9 * len(points)
        index = np.array([np.flatnonzero((points == point).all(axis=1))[0] for point in scan.points[::37]])
        np.testing.assert_allclose(scan.times[::37], offset[index], atol=2e-4)


CONVENTIONS = {
    "s after the start": ({}, "`timestamp`, s after the stamp (its start)"),
    "float ms": ({"point_unit": "ms"}, "`timestamp`, ms after the stamp"),
    "float µs": ({"point_unit": "us"}, "`timestamp`, µs after the stamp"),
    "whole µs": ({"point_unit": "us", "point_type": "u4"}, "`timestamp`, µs after the stamp"),
    "whole ns": ({"point_unit": "ns", "point_type": "u4"}, "`timestamp`, ns after the stamp"),
    "s before the end": ({"header_of": "end"}, "`timestamp`, s before the stamp (its end)"),
    "ms before the end": ({"header_of": "end", "point_unit": "ms", "point_type": "f4"}, "ms before the stamp"),
    "epoch s": ({"point_times": "epoch"}, "`timestamp`, absolute, s"),
    "epoch ns": ({"point_times": "epoch", "point_unit": "ns"}, "`timestamp`, absolute, ns"),
    "epoch µs": ({"point_times": "epoch", "point_unit": "us"}, "`timestamp`, absolute, µs"),
    **{f"{unit} since boot, {at:g} s": (
        {"point_times": "boot", "boot": at, "point_unit": unit}, f"by another clock, {unit}")
       for unit in ("s", "ns") for at in (5.0, 320.0, 1500.0, 3e4)},
    **{f"{times} in 32 bits": (
        {"point_times": times, "boot": 320.0, "point_unit": "ns", "point_type": "u4"}, "by another clock, ns")
       for times in ("boot", "epoch")},
    "a counter that wraps between two sweeps": (
        {"point_times": "boot", "boot": 4.294967296 * 7 - 1.15, "point_unit": "ns", "point_type": "u4"},
        "by another clock, ns"),
    "ring by ring, highest byte first": ({"by_ring": True, "big_endian": True}, "s after the stamp"),
    "ROS 2": ({"container": "mcap"}, "s after the stamp"),
    "a split SQLite of ROS 2": ({"container": "db3", "bags": 3}, "s after the stamp"),
    "a split MCAP of ROS 2": ({"container": "mcap", "bags": 2}, "s after the stamp"),
    "a folder of bags": ({"bags": 3}, "s after the stamp"),
}  # fmt: skip


@pytest.mark.parametrize("name", CONVENTIONS)
def test_a_convention_is_decided_once_and_said(tmp_path, name):
    how, said = CONVENTIONS[name]
    scans, facts = read(write_convention(tmp_path / "a.bag", **how))
    assert said in facts["point_times"]
    assert "sweeps of 0.098 s" in facts["point_times"]
    assert "points_without_time" not in facts
    agree(scans)


@pytest.mark.parametrize(("kind", "unit"), [("u4", "ns"), ("f8", "s"), ("f8", "us")])
def test_a_few_bad_times_are_left_out_and_counted(tmp_path, kind, unit):
    scans, facts = read(write_convention(tmp_path / "a.bag", point_type=kind, point_unit=unit, bad_times=0.01))
    agree(scans)
    missing = sum(len(points) for _, points, _ in sweeps(12)) - sum(len(scan.points) for scan in scans)
    assert facts["points_without_time"] == missing > 0


@pytest.mark.parametrize("how", [{}, {"point_type": "u4", "point_unit": "ns"}])
def test_many_bad_times_are_refused_with_their_fraction(tmp_path, how):
    bag = write_convention(tmp_path / "a.bag", bad_times=0.07, count=40, **how)
    with pytest.raises(RecordingError, match=r"a\.bag: [678]% of the points of /points"):
        read(bag)


def test_one_value_a_sweep_says_nothing_and_the_headers_rule(tmp_path):
    scans, facts = read(write_convention(tmp_path / "a.bag", point_times="constant"))
    assert facts["point_times"] == "`timestamp` is one value in each sweep: every sweep is taken as static"
    assert [scan.stamp for scan in scans] == pytest.approx([start for start, _, _ in sweeps(12)])
    assert not any(scan.times.any() for scan in scans)


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_what_the_user_says_of_the_unit_is_never_detected_away(tmp_path, unit):
    scans, facts = read(write_convention(tmp_path / "a.bag", point_unit="ms"), time_unit=unit)
    assert "(by flag)" in facts["point_times"]
    scale = {"s": 1e3, "ms": 1.0, "us": 1e-3, "ns": 1e-6}[unit]
    assert scans[3].times.max() == pytest.approx(0.098 * scale)


def test_what_the_user_says_of_the_stamp_moves_the_sweeps(tmp_path):
    after = write_convention(tmp_path / "a.bag")
    agree(read(after, time_stamp="start")[0])
    agree(read(after, time_stamp="end")[0], late=-0.098)
    for said in (None, "start", "end"):  # what nobody says another clock may still decide
        with Recording(after, times=TimeConfig(time_stamp=said)) as recording:
            assert recording.convention.guessed == (said is None)
    boot = write_convention(tmp_path / "b.bag", point_times="boot", boot=320.0)
    agree(read(boot, time_stamp="end")[0], late=-0.098)
    scans, _ = read(boot, time_unit="none")
    assert not any(scan.times.any() for scan in scans)


def own_bag(path, late, time):
    """Headers late by a number of each sweep, s, and times of points of a sensor of no known driver."""
    fields = [("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8), ("time", "f8", 16)]
    raw = [
        (at := start + late(k), pointcloud2(at, fields, 24, dict(zip("xyz", xyz.T, strict=True), time=time(k, offset))))
        for k, (start, xyz, offset) in enumerate(sweeps(12))
    ]
    return write_bag1(path, {"/points": raw})


def test_times_that_grow_by_no_unit_are_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"grow by 300 in a second of the headers: by no unit"):
        read(own_bag(tmp_path / "a.bag", lambda k: 0.0, lambda k, offset: 30 * (k + offset)))


def test_sweeps_by_another_clock_stand_as_even_as_it_runs_however_late_their_headers(tmp_path):
    late, boot = lambda k: 0.004 * (k % 3), lambda k, offset: 320.0 + k / 10 + offset
    scans, _ = read(own_bag(tmp_path / "a.bag", late, boot))
    np.testing.assert_allclose(np.diff([scan.stamp for scan in scans]), 0.1, atol=5e-4)


@pytest.mark.parametrize("how", [{"point_times": "epoch", "point_unit": "ns"}, {"container": "mcap", "chunks": 2}])
def test_a_recording_is_written_anew_as_another_driver_has_it(tmp_path, how):
    whole = write_convention(tmp_path / "a.bag", point_times="boot", boot=320.0)
    convention = Convention(**{"point_times": "header", **how})
    agree(read(rewrite(RewriteConfig(whole, tmp_path / "b.bag", convention=convention)))[0])
