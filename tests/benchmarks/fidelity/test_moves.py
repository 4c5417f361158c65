"""Nothing in the score is true by construction: for each scored metric a change of the scene moves value and score.

`moves.csv` holds, by metric, a change (see `changes.py`) with the values before and after it on the survey of seed 411.
The cheap tests score these values through today's thresholds; the slow one makes survey, scene and changes anew.
"""

import csv
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.fidelity import scoring, table
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.inputs import Inputs, complete_inputs, read_case, run_module
from benchmarks.fidelity.registry import Value, number
from tests.benchmarks.fidelity.changes import spoil_by
from tests.benchmarks.fidelity.judged import measure

MOVES = Path(__file__).with_name("moves.csv")
LEAST = 5.0  # points that the change must cost the metric
SEED = 411


@dataclass(frozen=True)
class Move:
    """A metric with a change of the scene; a value that could not be computed is one that failed."""

    id: str
    change: str
    before: Value
    after: Value

    @property
    def cost(self) -> float:
        """Points that the change costs the metric."""
        row = table.load()[self.id]
        before, after = (scoring.score_one(row, value).score for value in (self.before, self.after))
        assert before is not None, f"{self.id} is not scored"
        assert after is not None, f"{self.id} is not scored after: {self.change}"
        return before - after


def read_moves() -> list[Move]:
    """The saved values of `moves.csv`."""
    with MOVES.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [Move(row["id"], row["change"], *(_value(row[name]) for name in ("before", "after"))) for row in rows]


def _value(text: str) -> Value:
    return number(float(text)) if text else Value(None, failed=True)


def test_every_scored_metric_has_a_change_that_moves_it() -> None:
    counted = Counter(move.id for move in read_moves())
    assert counted == Counter(id for id, row in table.load().items() if row.scored)


@pytest.mark.parametrize("move", read_moves(), ids=lambda move: move.id)
def test_the_change_moves_value_and_score_of_its_metric(move: Move) -> None:
    assert move.before.value is not None
    assert move.before.value != move.after.value
    assert move.cost >= LEAST


def test_a_metric_that_nothing_moves_is_noticed() -> None:
    move = read_moves()[0]
    assert Move(move.id, move.change, move.before, move.before).cost < LEAST


def test_of_a_good_reconstruction_fewer_than_70_percent_of_the_metrics_have_full_marks() -> None:
    rows = table.load()
    full = [scoring.score_one(rows[move.id], move.before).score == 100.0 for move in read_moves()]
    assert sum(full) < 0.7 * len(full)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_on_a_survey_made_anew_every_change_moves_its_metric(tmp_path: Path) -> None:
    case = make_case(tmp_path)
    moves = read_moves()
    before = {move.id: measure(move.id, case) for move in moves}
    case.cache.clear()
    still = []
    for change in dict.fromkeys(move.change for move in moves):
        spoilt = spoil_by(case, change, tmp_path / change.replace(" ", "_"))
        for move in [move for move in moves if move.change == change]:
            again = Move(move.id, change, before[move.id], measure(move.id, spoilt))
            if again.before.value == again.after.value or again.cost < LEAST:
                still.append((move.id, change, again.before.value, again.after.value, again.cost))
        spoilt.cache.clear()
    assert still == []


def make_case(folder: Path) -> Case:
    """Simulates a 36 m survey, builds its scene from the Avia, and judges it by the OS1."""
    survey, scene = folder / "survey", folder / "scene"
    run_module("scene.survey", "--truth", "metro", "--length", 36, "--seed", SEED, "--tolerances",
               "--sensors", "avia", "os1", "--scan-every", 6, "--out", survey)  # fmt: skip
    run_module("scene.build", survey / "survey.bag", "--trajectory", survey / "groundtruth.tum",
               "--provenance", "simulated", "--out", scene)  # fmt: skip
    return read_case(complete_inputs(Inputs(
        scene=scene, recording=survey / "survey_os1.bag", trajectory=survey / "groundtruth_os1.tum", truth=survey,
        fit_recording=survey / "survey.bag", fit_trajectory=survey / "groundtruth.tum",
    )))  # fmt: skip
