"""Blocks of time: shares, guards, messages as they were."""

import json
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Reader

from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.inputs import GUARD, SplitConfig, deal_blocks, part_at, split_recording
from tests.scene.bags import write_bag

CONFIG = SplitConfig()


def test_each_hand_of_five_blocks_holds_the_shares() -> None:
    dealt = deal_blocks(100.0, CONFIG)
    hands = dealt[: len(dealt) // 5 * 5].reshape(-1, 5)
    assert {tuple(np.bincount(hand, minlength=3)) for hand in hands} == {(3, 1, 1)}


def test_times_near_a_border_between_parts_belong_to_nobody() -> None:
    dealt = np.array([0, 2, 2, 1, 0])
    assert part_at(1.85, dealt, CONFIG) == 0
    assert part_at(1.95, dealt, CONFIG) == GUARD
    assert part_at(2.05, dealt, CONFIG) == GUARD
    assert part_at(3.99, dealt, CONFIG) == 2


def test_neighbouring_parts_are_a_guard_apart() -> None:
    dealt = deal_blocks(60.0, CONFIG)
    times = np.arange(0.0, 60.0, 0.01)
    parts = np.array([part_at(t, dealt, CONFIG) for t in times])
    kept = parts != GUARD
    changes = np.flatnonzero(np.diff(parts[kept]) != 0)
    assert np.diff(times[kept])[changes].min() >= CONFIG.guard - 0.011
    assert np.bincount(parts[kept]) / kept.sum() == pytest.approx([0.6, 0.2, 0.2], abs=0.05)


def test_a_bag_is_cut_into_parts_of_raw_messages(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(4, 3))
    source = write_bag(tmp_path / "whole.bag", [(100.0 + 0.25 * k, points + k) for k in range(200)])
    facts = split_recording(source, tmp_path / "parts", CONFIG)
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
        split_recording(wrong, tmp_path / "parts", CONFIG)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["wrong.bag"]


def test_a_recording_shorter_than_five_blocks_is_refused(tmp_path: Path) -> None:
    short = write_bag(tmp_path / "short.bag", [(100.0 + k, np.ones((2, 3))) for k in range(5)])
    with pytest.raises(FidelityError, match="shorter than five blocks"):
        split_recording(short, tmp_path / "parts", CONFIG)
    assert not (tmp_path / "parts").exists()
