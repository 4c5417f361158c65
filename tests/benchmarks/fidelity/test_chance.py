"""Random faults: kept as they are done, summed up as detection curves, refused where they cannot be drawn."""

import json

import numpy as np
import pytest

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.controls import chance
from benchmarks.fidelity.files import FidelityError
from tests.benchmarks.fidelity import tube


@pytest.fixture(scope="module")
def case() -> Case:
    return tube.case(tube.Tube(length=20.0), beams=1200)


def test_faults_are_kept_one_by_one_and_taken_up_again(case, tmp_path, monkeypatch) -> None:
    done = []
    known = chance.noticed_by

    def once(*words):
        done.append(1)
        if len(done) == 2:
            raise KeyboardInterrupt
        return known(*words)

    monkeypatch.setattr(chance, "noticed_by", once)
    with pytest.raises(KeyboardInterrupt):
        chance.run_faults(case, 2, 0, ("rails", "wall"), tmp_path)
    first = chance.read_rows(tmp_path)
    assert len(first) == 1
    rows = chance.run_faults(case, 2, 0, ("rails", "wall"), tmp_path)
    assert rows[0] == first[0]
    assert [row["kind"] for row in rows] == ["rails", "wall"]
    assert len(done) == 3
    assert len(chance.run_faults(case, 2, 1, ("rails", "wall"), tmp_path)) == 2  # another draw begins anew
    assert len(done) == 5


def test_the_smallest_size_noticed_is_that_from_which_on_all_but_one_in_twenty_are() -> None:
    size = np.geomspace(0.01, 0.16, 60)
    assert chance.smallest_noticed(size, size > 0.04) == pytest.approx(0.04, rel=0.06)
    assert chance.smallest_noticed(size, np.zeros(60, bool)) is None
    assert chance.smallest_noticed(size[:3], np.ones(3, bool)) is None  # too few to say
    large_missed = size > 0.04
    large_missed[-3:] = False
    assert chance.smallest_noticed(size, large_missed) is None


def test_curves_are_written_over_several_scenes(tmp_path) -> None:
    rows = [
        {"scene": f"t{k % 2}", "number": k, "kind": "wall", "start": 5.0, "length": 4.0 + k % 5, "size": 0.01 * (k + 1),
         "side": 0.0, "by": ["sector.truth"] if k > 2 else []}
        for k in range(12)
    ]  # fmt: skip
    table = chance.write_curves(tmp_path, rows)
    assert table[0]["count"] == 12
    assert table[0]["noticed"] == 9
    assert table[0]["largest_missed"] == pytest.approx(0.03)
    assert "wall," in (tmp_path / "curves.csv").read_text()
    assert (tmp_path / "curves.png").stat().st_size > 10_000


def test_a_draw_that_cannot_be_made_is_refused(tmp_path) -> None:
    for words, says in (
        ((0, 0, ()), "count"),
        ((1, -1, ()), "draw"),
        ((1, 0, ("mirror",)), "no kind of fault 'mirror'"),
    ):
        with pytest.raises(FidelityError, match=says):
            chance.check_draw(*words)
    (tmp_path / "faults.json").write_text(json.dumps({"schema": "another"}))
    with pytest.raises(FidelityError, match="schema is not"):
        chance.read_rows(tmp_path)
