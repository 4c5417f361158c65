"""The ladder of sizes finds known thresholds, and goes on where it was cut short."""

import numpy as np
import pytest

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.faults import ladder
from benchmarks.fidelity.files import FidelityError
from tests.benchmarks.fidelity import tube


@pytest.fixture(scope="module")
def good() -> Case:
    return tube.case(tube.Tube(length=24.0), beams=2000)


def test_a_ladder_finds_the_limit_and_goes_on_where_it_was(good, tmp_path, monkeypatch) -> None:
    rows = ladder.climb_ladders(good, ("gauge", "rails"), 1, 5, tmp_path)
    for row in rows:
        sizes = ladder.rungs(row["kind"])
        by = {round(one["size"], 9): one["by"] for one in row["tried"]}
        assert by[round(sizes[row["rung"]], 9)]  # noticed there
        assert not by[round(sizes[row["rung"] - 1], 9)]  # and not below
    # The limits are 2 mm for a change of gauge and 12 mm for height.
    assert all(0.0015 < ladder.rungs("gauge")[row["rung"]] < 0.0035 for row in rows if row["kind"] == "gauge")
    assert all(0.009 < ladder.rungs("rails")[row["rung"]] < 0.017 for row in rows if row["kind"] == "rails")
    with monkeypatch.context() as patch:
        patch.setattr(ladder, "noticed_by", lambda *_: pytest.fail("done already"))
        again = ladder.climb_ladders(good, ("gauge", "rails"), 1, 5, tmp_path)
    assert [(one["kind"], one["number"], one["rung"]) for one in again] == [
        (one["kind"], one["number"], one["rung"]) for one in rows
    ]
    table = ladder.write_ladder(tmp_path, rows)
    assert [one["noticed_at_asked"] for one in table] == [1, 1]
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


def test_a_ladder_that_cannot_be_climbed_is_refused(tmp_path) -> None:
    for words, says in (((("box",), 1, 0), "no size of 'box'"), (((), 0, 0), "places"), (((), 1, -1), "draw")):
        with pytest.raises(FidelityError, match=says):
            ladder.check_ladder(*words)
    short = tube.case(tube.Tube(length=12.0), beams=60)
    with pytest.raises(FidelityError, match="needs 19 m of tunnel"):
        ladder.climb_ladders(short, (), 1, 0, tmp_path)
