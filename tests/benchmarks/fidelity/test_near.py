"""Windows near a fault alone, and the ladder of sizes: the values of the whole tunnel, and known thresholds."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.controls import chance, ladder
from benchmarks.fidelity.controls.local import Fault, Ground, make_ground, spoil
from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.windows.judge import noticed_by, worst_windows
from benchmarks.fidelity.windows.measures import MEASURES, Series
from benchmarks.fidelity.windows.near import Nearby
from tests.benchmarks.fidelity import tube

LENGTH = 60.0
FAULTS = (
    Fault("wall", 14.0, 5.0, 0.05, np.pi), Fault("roof", 50.0, 8.0, -0.06, np.pi / 2), Fault("along", 25.0, 6.0, 0.2),
    Fault("rails", 2.0, 4.0, 0.03), Fault("sleepers", 30.0, 6.0, 0.2), Fault("pockets", 20.0, 7.0, 0.8),
    Fault("box", 40.0, 5.0, 0.6),
)  # fmt: skip


@pytest.fixture(scope="module")
def ground() -> Ground:
    return make_ground(tube.case(tube.Tube(length=LENGTH), beams=3000).candidate)


@pytest.fixture(scope="module")
def good(ground) -> Case:
    return replace(tube.case(tube.Tube(length=LENGTH), beams=3000), candidate=ground.candidate)


@pytest.fixture(scope="module")
def whole(good) -> dict[str, Series]:
    return windows(good)


@pytest.fixture(scope="module")
def nearby(good, ground) -> Nearby:
    return Nearby(good, ground, worst_windows(good))


def windows(case: Case) -> dict[str, Series]:
    kept: dict[str, Series] = {}
    worst_windows(case, kept)
    return kept


@pytest.mark.parametrize("fault", FAULTS, ids=lambda one: one.kind)
def test_windows_near_a_fault_are_those_of_the_whole_tunnel_and_no_other_is_changed(good, whole, nearby, fault) -> None:
    spoilt = spoil(nearby.ground, fault)
    full = windows(replace(good, candidate=spoilt, cache={}))
    near = replace(nearby._cut(*fault.extent()), candidate=spoilt)
    changed = 0
    for source in ("recording", "truth"):
        for one in MEASURES:
            if one.id == "hand":
                continue
            name = f"{one.id}.{source}"
            mine, before, after = one.compute(near, source), whole[name], full[name]
            place = [int(np.argmin(np.abs(after.start - start))) for start in mine.start]
            np.testing.assert_allclose(after.start[place], mine.start, atol=1e-6)
            np.testing.assert_allclose(after.value[place], mine.value, atol=5e-5)  # a ray may just miss an edge
            other = ~np.isclose(after.value, before.value, atol=1e-9, equal_nan=True)
            changed += int(other.sum())
            shadow = fault.kind == "box" and source == "recording"  # farther on, beams that it holds up
            if one.id != "gauge_change" and not shadow:  # that is against the median of the whole track
                assert set(np.flatnonzero(other)) <= set(place), name
    assert changed


def test_a_fault_is_noticed_near_it_where_it_is_noticed_in_the_whole_tunnel(good, nearby) -> None:
    before = worst_windows(good)
    for fault in (Fault("wall", 12.0, 5.0, 0.08), Fault("gauge", 30.0, 10.0, 0.006), Fault("rails", 30.0, 6.0, 0.003)):
        spoilt = spoil(nearby.ground, fault)
        first, every = nearby.first_beyond(spoilt, *fault.extent()), noticed_by(good, spoilt, before)
        assert bool(first) == bool(every)
        assert not first or first in every


@pytest.mark.slow
def test_random_faults_may_be_judged_near_them(good, tmp_path) -> None:
    rows = chance.run_faults(good, 2, 3, ("rails", "wall"), tmp_path / "near", near=True)
    full = chance.run_faults(good, 2, 3, ("rails", "wall"), tmp_path / "whole")
    assert [bool(row["by"]) for row in rows] == [bool(row["by"]) for row in full]
    assert all(len(row["by"]) <= 1 for row in rows)


def test_a_ladder_finds_the_limit_and_goes_on_where_it_was(good, tmp_path, monkeypatch) -> None:
    rows = ladder.climb_ladders(good, ("gauge", "rails"), 2, 5, tmp_path)
    for row in rows:
        sizes = ladder.rungs(row["kind"])
        by = {round(one["size"], 9): one["by"] for one in row["tried"]}
        assert by[round(sizes[row["rung"]], 9)]  # noticed there
        assert not by[round(sizes[row["rung"] - 1], 9)]  # and not below
    # The limits are 2 mm for a change of gauge and 12 mm for height.
    assert all(0.0015 < ladder.rungs("gauge")[row["rung"]] < 0.0035 for row in rows if row["kind"] == "gauge")
    assert all(0.009 < ladder.rungs("rails")[row["rung"]] < 0.017 for row in rows if row["kind"] == "rails")
    with monkeypatch.context() as patch:
        patch.setattr(Nearby, "first_beyond", lambda *_: pytest.fail("done already"))
        again = ladder.climb_ladders(good, ("gauge", "rails"), 2, 5, tmp_path)
    assert [(one["kind"], one["number"], one["rung"]) for one in again] == [
        (one["kind"], one["number"], one["rung"]) for one in rows
    ]
    table = ladder.write_ladder(tmp_path, rows)
    assert [one["noticed_at_asked"] for one in table] == [2, 2]
    assert (tmp_path / "ladder.csv").read_text().count("\n") == 3
    assert (tmp_path / "ladder.png").stat().st_size > 10_000


def test_the_smallest_rung_is_found_whatever_is_guessed() -> None:
    for smallest in range(17):
        for guess in range(-1, 16):
            low, high, rung, tries = -1, 16, 12, 0
            while high - low > 1:
                low, high, tries = (low, rung, tries + 1) if rung >= smallest else (rung, high, tries + 1)
                rung = ladder.next_rung(low, high, guess)
            assert high == min(smallest, 16)
            assert tries <= (3 if smallest == guess and smallest > 0 else 7)


def test_the_curve_of_known_thresholds_is_found_again() -> None:
    rng = np.random.default_rng(2)
    sizes = ladder.rungs("wall")
    thresholds = 0.02 * np.exp(0.25 * rng.standard_normal(400))
    rows = [{"kind": "wall", "rung": int(np.searchsorted(sizes, one))} for one in thresholds]
    (one,) = ladder.sum_up(rows)
    assert one["size_50"] == pytest.approx(0.02, rel=0.05)
    assert one["size_95"] == pytest.approx(0.02 * np.exp(0.25 * 1.645), rel=0.06)
    assert one["low"] < one["size_95"] < one["high"]
    share = ladder.share_noticed(np.array([len(sizes)] * 10), len(sizes))
    assert share[0].max() == 0.0
    assert share[2].max() == pytest.approx(0.308, abs=0.01)
    never = ladder.sum_up([{"kind": "wall", "rung": len(sizes)}] * 10)[0]
    assert never["size_95"] > sizes[-1]


def test_a_ladder_that_cannot_be_climbed_is_refused() -> None:
    for words, says in (
        (((), 0, 60.0), "places"),
        ((("box",), 1, 60.0), "no size of 'box'"),
        (((), 1, 15.0), "needs 19 m"),
    ):
        with pytest.raises(FidelityError, match=says):
            ladder.check_ladder(*words)
