"""Worst windows: known answers on a tube, faults that must be noticed, and where they are."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fidelity import judge
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.faults import Fault, put_in
from benchmarks.fidelity.faults.kinds import local_site, stated_faults
from benchmarks.fidelity.registry import Value
from benchmarks.fidelity.windows import deviation
from benchmarks.fidelity.windows import judge as windows_of
from benchmarks.fidelity.windows.judge import Noticed, Windows
from tests.benchmarks.fidelity import tube

LENGTH = 24.0


@pytest.fixture(scope="module")
def good() -> Case:
    return tube.case(tube.Tube(length=LENGTH), beams=2500)


@pytest.fixture(scope="module")
def before(good) -> dict[str, windows_of.Worst]:
    return by_name(good)


def by_name(case: Case) -> dict[str, windows_of.Worst]:
    return {f"{one.id}.{one.source}": one for one in windows_of.worst_windows(case)}


def with_fault(good: Case, fault: Fault) -> dict[str, windows_of.Worst]:
    return by_name(put_in(local_site(good), fault))


def test_a_right_tube_has_no_window_beyond_its_limit(before) -> None:
    assert [name for name, one in before.items() if one.beyond] == []
    assert before["wall.truth"].value == pytest.approx(0.0, abs=1e-6)
    assert before["gauge.truth"].value == pytest.approx(0.0, abs=1e-4)
    assert before["wall.recording"].value < 0.008  # 2 cm of noise, medians of some returns
    assert before["shift.recording"].value < 0.02


def test_a_wall_that_is_out_is_measured_and_placed(good) -> None:
    found = with_fault(good, Fault("wall", 0.10, 8.0, 5.0, 0.0))
    for name in ("sector.truth", "sector.recording"):
        worst = found[name]
        assert worst.value == pytest.approx(0.10, abs=0.02)
        assert worst.where == "left wall"
        assert abs(worst.start - 8.0) < 1.2
        assert worst.beyond
    assert found["aside.truth"].value == pytest.approx(0.05, abs=0.015)  # half of it: only one wall has moved


def test_what_moves_along_the_tunnel_or_stands_apart_is_measured(good) -> None:
    along = with_fault(good, Fault("along", 0.15, 7.0, 10.0))
    assert along["shift.truth"].value == pytest.approx(0.15, abs=0.03)
    assert along["shift.recording"].value == pytest.approx(0.15, abs=0.03)
    rails = with_fault(good, Fault("rails", 0.03, 8.0, 6.0))
    assert rails["rail_height.truth"].value == pytest.approx(0.03, abs=0.003)
    assert rails["rail_height.recording"].value == pytest.approx(0.03, abs=0.006)
    gauge = with_fault(good, Fault("gauge", -0.006, 6.0, 11.0))
    assert gauge["gauge.truth"].value == pytest.approx(0.006, abs=0.001)
    assert {name for name, one in gauge.items() if one.beyond} == {"gauge.truth", "gauge_change.truth"}


def test_a_relief_is_found_where_it_was_moved_to_and_points_beyond_its_ends_count_for_nothing() -> None:
    rng = np.random.default_rng(3)
    station = np.arange(0.025, 40.0, deviation.FINE)
    blocks = np.repeat(np.repeat(rng.normal(0.0, 0.03, (80, deviation.COLUMNS // 6)), 10, 0), 6, 1)
    judged = deviation.Relief(station, 2.5 + blocks)
    judged.radius[rng.random(judged.radius.shape) < 0.02] = np.nan
    at, angle = rng.uniform(-2.0, 42.0, 60_000), rng.uniform(-np.pi, np.pi, 60_000)
    starts = np.array([-1.5, 0.0, 12.0, 31.0, 60.0])

    def found(shift: float) -> np.ndarray:
        row = np.clip(((at + shift) / deviation.FINE).astype(int), 0, len(station) - 1)
        seen = 2.6 + blocks[row, ((angle + np.pi) / (2.0 * np.pi) * deviation.COLUMNS).astype(int) % deviation.COLUMNS]
        return deviation.shift_by_window(at, angle, seen + 0.004 * at, judged, starts, 10.0)

    for shift in (-0.35, 0.0, 0.1, 0.12, 0.35):
        within = 0.006 if shift == 0.12 else 0.004  # that of between two rays
        np.testing.assert_allclose(found(shift)[:4], shift, atol=within)
        assert np.isnan(found(shift)[4])  # no points there
    assert np.isnan(found(deviation.REACH + 0.1)).all()
    smooth = deviation.Relief(station, np.full((len(station), deviation.COLUMNS), 2.5))
    assert np.isnan(deviation.shift_by_window(at, angle, np.full(len(at), 2.5), smooth, starts, 10.0)).all()


def test_a_wall_far_out_counts_as_half_a_metre(good) -> None:
    found = with_fault(good, Fault("wall", 0.9, 8.0, 5.0, 0.0))
    for name in ("spot.truth", "spot.recording"):
        assert found[name].value == pytest.approx(0.5, abs=0.01), name


def test_filled_pockets_lost_sleepers_and_a_cube_are_noticed(good) -> None:
    for fault, window in (
        (Fault("pockets", 0.9, 8.0, 7.0), "pockets.truth"),
        (Fault("missing", 1.0, 8.0, 7.0), "bed.truth"),
        (Fault("box", 0.9, 8.0, 5.0, np.pi), "spot.recording"),
    ):
        found = with_fault(good, fault)
        assert found[window].beyond, fault


def test_a_cell_that_shows_mostly_track_says_nothing_of_the_bore(good) -> None:
    case = put_in(local_site(good), Fault("track", 0.008))
    frame, one, on_track = (
        deviation.hold_frame(case),
        deviation.hold_map(case),
        np.isin(deviation.parts_hit(case), deviation.TRACK),
    )
    cells = one.offset.size
    total, track = (np.bincount(frame.cell[rows & (frame.cell >= 0)], minlength=cells) for rows in (True, on_track))
    mostly = track > 0.5 * total
    assert (mostly & (total - track >= deviation.LEAST)).any()  # beams that miss the track by a hair
    assert np.isnan(one.offset.ravel()[mostly]).all()
    assert np.isfinite(one.offset.ravel()[(track == 0) & (total >= 4 * deviation.LEAST)]).mean() > 0.95


def test_a_mirrored_tube_fails_where_its_sides_differ_and_a_symmetric_one_cannot_tell(good, before) -> None:
    assert before["hand.truth"].value is None  # its sides are alike
    one_sided = put_in(local_site(good), Fault("wall", 0.08, 6.0, 4.0, np.pi / 4)).candidate
    surface = replace(good.truth, surface=one_sided.lining, part=np.zeros(len(one_sided.lining.faces), int), cache={})
    uneven = replace(good, candidate=one_sided, truth=surface, hold=None, cache={})
    assert by_name(uneven)["hand.truth"].value == pytest.approx(0.0, abs=0.05)
    found = with_fault(uneven, stated_faults(LENGTH)["mirrored left to right"])["hand.truth"]
    assert found.value == pytest.approx(2.0, abs=0.1)
    assert found.beyond


def test_a_fault_leaves_the_rest_of_the_tunnel_exactly_alone(good) -> None:
    site, lining = local_site(good), good.candidate.lining
    station = site.line.local(np.asarray(lining.vertices))[:, 0]
    for kind, size in (("wall", 0.15), ("floor", 0.15), ("aside", 0.15), ("lift", 0.15), ("along", 0.35),
                       ("roll", 0.06), ("gauge", 0.02), ("rails", 0.06), ("track", 0.06), ("sleepers", 0.28),
                       ("missing", 1.0), ("pockets", 1.0), ("box", 1.0), ("section", 0.05)):  # fmt: skip
        corrupted = put_in(site, Fault(kind, size, 10.0, 4.0)).candidate
        moved = np.abs(np.asarray(corrupted.lining.vertices) - lining.vertices).max(axis=1)
        assert moved[(station < 6.5) | (station > 17.5)].max() == 0.0, kind


def test_windows_and_faults_that_go_unnoticed_decide_the_verdict() -> None:
    fine = {"base": {}, "null": {}}
    worst = windows_of.Worst("wall", "mean distance of the walls", "truth", "m", 0.07, 0.02, 12.0, 17.0, "", 1.0)
    missed = Windows((), (Noticed("roof 8 cm too low", ()),))
    other = Windows((replace(worst, value=0.01),), (Noticed("gauge 6 mm too wide", (), needed=False),))
    assert other.reasons() == []
    assert "would not notice" in missed.reasons()[0]
    reason = Windows((worst,)).reasons()[0]
    assert "7.0 cm from station 12 to 17 m" in reason
    assert windows_of.load_windows(windows_of.dump_windows(Windows((worst,), missed.noticed))) == Windows(
        (worst,), missed.noticed
    )
    values = {id: Value(None, reason="none") for id in judge.table.load()}
    judged = judge.make_judgement(dict.fromkeys(fine, values), [], windows=Windows((worst,)))
    assert reason in judged.reasons
    assert judged.verdict == "FAIL"


def test_a_recording_is_judged_by_the_limits_of_its_own_sensor() -> None:
    topics = {"/ouster/points": "os1", "/livox/lidar": "avia", "/velodyne_points": "vlp16", "/rslidar": None}
    assert {topic: windows_of.sensor_of(topic) for topic in topics} == topics
    for sensor in windows_of.SENSORS:
        assert {name: limit for name, limit in windows_of.limits(sensor).items() if name.endswith("truth")} == {
            name: limit for name, limit in windows_of.limits().items() if name.endswith("truth")
        }


def test_a_window_beyond_a_limit_that_another_sensor_set_says_so(good) -> None:
    beams = replace(good.hold, range=good.hold.range + 0.2, cache={})
    said = {}
    for topic in ("/rslidar_points", "/ouster/points"):
        found = by_name(replace(good, hold=replace(beams, sensor=topic, cache={}), cache={}))
        assert found["wall.recording"].beyond
        said[topic] = found["wall.recording"].sentence()
    assert "which was not set with the sensor of /rslidar_points" in said["/rslidar_points"]
    assert "not set with" not in said["/ouster/points"]


def test_what_a_sensor_cannot_judge_is_not_judged_by_it(good, before) -> None:
    livox = by_name(replace(good, hold=replace(good.hold, sensor="/livox/lidar", cache={}), cache={}))
    assert livox["spot.recording"].value is None
    assert not livox["spot.recording"].beyond
    assert before["spot.recording"].value is not None
    assert livox["sector.recording"].value == before["sector.recording"].value
