"""The ladder of sizes finds known thresholds, and goes on where it was cut short."""

import numpy as np
import pytest

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.faults import runner as ladder
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
    assert [one["noticed_at_asked"] for one in ladder.sum_up(rows)] == [1, 1]


def test_the_sizes_that_half_and_95_percent_of_places_notice_are_known() -> None:
    sizes = ladder.rungs("wall")
    (one,) = ladder.sum_up([{"kind": "wall", "rung": rung} for rung in [3] * 10 + [5] * 9 + [9]])
    assert (one["size_50"], one["size_95"], one["noticed_at_asked"]) == (sizes[5], sizes[9], 20)
    (never,) = ladder.sum_up([{"kind": "wall", "rung": len(sizes)}] * 10)
    assert (never["size_95"], never["noticed_at_asked"]) == (np.inf, 0)


def test_a_ladder_that_cannot_be_climbed_is_refused(tmp_path) -> None:
    for words, says in (((("box",), 1, 0), "no size of 'box'"), (((), 0, 0), "places"), (((), 1, -1), "draw")):
        with pytest.raises(FidelityError, match=says):
            ladder.check_ladder(*words)
    short = tube.case(tube.Tube(length=12.0), beams=60)
    with pytest.raises(FidelityError, match="needs 19 m of tunnel"):
        ladder.climb_ladders(short, (), 1, 0, tmp_path)
