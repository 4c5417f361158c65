"""Mistakes of a user with the commands, recordings that do not fit, and the cut of a recording."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.rosbag1 import Reader

from benchmarks.fidelity import inputs
from benchmarks.fidelity.derive import beams, distances
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.references import HoldConfig
from subterra_jax.host.errors import SubterraError
from tests.benchmarks.fidelity import tube
from tests.scene.bags import write_bag


def test_a_recording_without_poses_and_references_without_a_scene_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FidelityError, match="--recording and --trajectory go together"):
        inputs.complete_inputs(inputs.Inputs(scene=tmp_path, recording=tmp_path))
    with pytest.raises(FidelityError, match="need --scene"):
        inputs.complete_inputs(inputs.Inputs(truth=tmp_path))
    for wrong in ({"seed": -1}, {"hold": HoldConfig(sigma=0.0)}, {"hold": HoldConfig(beams_per_scan=0)}):
        with pytest.raises(SubterraError, match="must"):
            inputs.complete_inputs(inputs.Inputs(**wrong))


def test_the_noise_of_a_sensor_comes_from_its_data_sheet() -> None:
    assert inputs.with_sigma(HoldConfig(), Path("survey_os1.bag")).sigma == 0.03
    assert inputs.with_sigma(HoldConfig(), Path("unknown.bag")).sigma == HoldConfig().sigma
    assert inputs.with_sigma(HoldConfig(sigma=0.011), Path("survey_os1.bag")).sigma == 0.011


SCENE, BAG = Path("tunnel"), Path("held.bag")
LONG = tube.Tube(length=48.0)


def test_a_recording_in_another_frame_is_refused() -> None:
    hold = tube.hold(tube.Tube(), beams=2000)
    away = replace(hold, origin=hold.origin + np.array([300.0, 40.0, 0.0]), cache={})
    with pytest.raises(FidelityError, match=r"held.bag: its sensor lies 29\d m from the tunnel of tunnel"):
        inputs.check_recording(tube.candidate(), away, SCENE, BAG)


def test_a_recording_of_a_part_is_refused_unless_that_is_asked_for() -> None:
    hold = tube.hold(LONG, beams=2000)
    station = tube.candidate(LONG).bore.station
    points = hold.origin + hold.range[:, None] * hold.direction
    end = tube.candidate(LONG).bore.position[np.searchsorted(station, 24.0)]
    ahead = tube.candidate(LONG).bore.tangent[0]
    kept = ((points - end) @ ahead < 0.0) & ((hold.origin - end) @ ahead < 0.0)
    names = ("time", "scan", "origin", "direction", "range")
    half = replace(hold, **{name: getattr(hold, name)[kept] for name in names}, cache={})
    with pytest.raises(FidelityError, match=r"held.bag: shows 2\d of the 48 m of tunnel, nothing for instance at stat"):
        inputs.check_recording(tube.candidate(LONG), half, SCENE, BAG)
    inputs.check_recording(tube.candidate(LONG), half, SCENE, BAG, partial=True)


def test_a_tunnel_shorter_than_a_window_is_refused() -> None:
    with pytest.raises(FidelityError, match=r"tunnel: its tunnel is 8\.0 m long, and a window along it 10 m"):
        inputs.check_length(tube.candidate(tube.Tube(length=8.0)), SCENE)
    inputs.check_length(tube.candidate(), SCENE)


CONFIG = inputs.SplitConfig()


def test_times_near_a_border_between_parts_belong_to_nobody() -> None:
    dealt = np.array([0, 2, 2, 1, 0])
    assert inputs.part_at(1.85, dealt, CONFIG) == 0
    assert inputs.part_at(1.95, dealt, CONFIG) == inputs.GUARD
    assert inputs.part_at(2.05, dealt, CONFIG) == inputs.GUARD
    assert inputs.part_at(3.99, dealt, CONFIG) == 2


def test_neighbouring_parts_are_a_guard_apart() -> None:
    dealt = inputs.deal_blocks(60.0, CONFIG)
    times = np.arange(0.0, 60.0, 0.01)
    parts = np.array([inputs.part_at(t, dealt, CONFIG) for t in times])
    kept = parts != inputs.GUARD
    changes = np.flatnonzero(np.diff(parts[kept]) != 0)
    assert np.diff(times[kept])[changes].min() >= CONFIG.guard - 0.011
    assert np.bincount(parts[kept]) / kept.sum() == pytest.approx([0.6, 0.2, 0.2], abs=0.05)


def test_a_bag_is_cut_into_parts_of_raw_messages(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(4, 3))
    source = write_bag(tmp_path / "whole.bag", [(100.0 + 0.25 * k, points + k) for k in range(200)])
    facts = inputs.split_recording(source, tmp_path / "parts", CONFIG)
    assert json.loads((tmp_path / "parts" / "split.json").read_text()) == json.loads(json.dumps(facts))
    seen: dict[int, bytes] = {}
    for name in ("fit", "val", "hold"):
        rows = messages(tmp_path / "parts" / f"{name}.bag")
        assert len(rows) == facts["messages"][name]
        assert not set(rows) & set(seen)
        seen |= rows
    whole = messages(source)
    assert all(whole[stamp] == raw for stamp, raw in seen.items())
    assert len(whole) == len(seen) + facts["messages"]["guard"] == 200


def messages(bag: Path) -> dict[int, bytes]:
    with Reader(bag) as reader:
        return {stamp: bytes(raw) for _, stamp, raw in reader.messages()}


def test_what_is_no_bag_is_named_and_nothing_is_written(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.bag"
    wrong.write_text("no bag")
    with pytest.raises(FidelityError, match=r"wrong\.bag: is no bag"):
        inputs.split_recording(wrong, tmp_path / "parts", CONFIG)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["wrong.bag"]


def test_a_recording_shorter_than_five_blocks_is_refused(tmp_path: Path) -> None:
    short = write_bag(tmp_path / "short.bag", [(100.0 + k, np.ones((2, 3))) for k in range(5)])
    with pytest.raises(FidelityError, match="shorter than five blocks"):
        inputs.split_recording(short, tmp_path / "parts", CONFIG)
    for wrong in ({"block": 0.0}, {"guard": 2.0}, {"fractions": (0.5, 0.5, 0.5)}):
        with pytest.raises(SubterraError, match=r"block|fractions"):
            inputs.split_recording(short, tmp_path / "parts", inputs.SplitConfig(**wrong))
    assert not (tmp_path / "parts").exists()


def test_a_metre_is_shown_by_thirty_returns_near_the_axis_and_not_by_one_less() -> None:
    line = Curve.through(np.column_stack([np.arange(0.0, 4.1, 0.5), np.zeros((9, 2))]))
    number = np.array([30, 29, 31, 30])
    place = np.column_stack([np.repeat(np.arange(4) + 0.5, number), np.zeros((number.sum(), 2))])
    place[-1, 1] = 9.0  # too far aside
    assert inputs._shown_metres(line, SimpleNamespace(points=place), 5.0).tolist() == [True, False, True, False]


def test_of_a_long_recording_returns_evenly_spaced_in_time_are_measured(monkeypatch) -> None:
    monkeypatch.setattr(beams, "returns", lambda case: SimpleNamespace(range=np.zeros(360_000)))
    rows = distances.thinned_rows(SimpleNamespace(hold=SimpleNamespace(cache={}), seed=0))
    assert (len(rows), rows[0], rows[-1], set(np.diff(rows))) == (120_000, 0, 359_999, {2, 3, 4} & set(np.diff(rows)))
