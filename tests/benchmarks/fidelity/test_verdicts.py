"""Verdicts, the constants beneath them, and the ladder that finds how small a fault is seen."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.fidelity import judge, scoring, table
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.faults import runner as ladder
from benchmarks.fidelity.faults.runner import Bench, Job, Outcome, judge_outcomes, run_control, run_jobs
from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.inputs import Inputs
from benchmarks.fidelity.judge import Judgement
from benchmarks.fidelity.registry import Value, missing
from benchmarks.fidelity.report import figures, write_report
from benchmarks.fidelity.report.figures import Sheet
from tests.benchmarks.fidelity import tube

Values = dict[str, Value]


def values(quality: float, worse: tuple[str, ...] = (), much: float = 0.0) -> Values:
    """Every metric at a fraction of the way from its bad end to its good one; some categories at another."""
    made = {}
    for id, row in table.load().items():
        fraction = much if row.category in worse else quality
        distance = row.map.bad + fraction * (row.map.good - row.map.bad)
        made[id] = Value(distance + (row.map.target if row.map.kind == "B" else 0.0))
        if row.map.kind == "P":
            made[id] = Value(float(fraction > 0.5))
    return made


def base() -> Judgement:
    all_of = {"base": values(0.98), "null": values(0.8), "ceiling": values(1.0)}
    scored = {name: scoring.score_all(entry) for name, entry in all_of.items()}
    return Judgement(all_of, scored, None, [], [])


def outcome(control: str, dose: float, made: Values, leaks: tuple[str, ...] = ()) -> Outcome:
    return Outcome(Job(control, dose), made, list(leaks))


def test_a_good_reconstruction_passes_and_a_null_tube_beside_it_does_not() -> None:
    made = {"base": values(0.98), "null": values(0.8), "ceiling": values(1.0)}
    found = judge.make_judgement(made, [])
    assert found.verdict == "PASS", found.reasons
    assert found.skill == pytest.approx(0.9, abs=0.02)
    assert judge.make_judgement(made | {"base": made["null"]}, []).verdict == "FAIL"
    assert judge.make_judgement(made, ["the builder read it"]).reasons == ["leak: the builder read it"]


def test_what_just_meets_every_bound_of_the_verdict_passes_and_what_is_below_one_does_not() -> None:
    scored = scoring.score_all(values(0.98))
    bound = replace(scored, overall=90.0, categories=dict.fromkeys(scored.categories, 70.0))
    null = replace(scored, overall=80.0)
    assert scoring.reasons_against(bound, null, 0.3, [], [], []) == []
    for low, other, skill, said in (
        (replace(bound, overall=89.99), replace(null, overall=70.0), 0.3, "global 90.0 is below 90"),
        (replace(bound, categories=bound.categories | {"CEN": 69.9}), null, 0.3, "category CEN is 69.9, below 70"),
        (bound, replace(null, overall=80.1), 0.3, "only 9.9 points above the null tube; 10 are asked"),
        (bound, null, 0.29, "median skill over the null tube is 0.29, below 0.3"),
    ):  # fmt: skip
        assert scoring.reasons_against(low, other, skill, [], [], []) == [said]


def test_a_control_that_falls_as_asked_is_detected() -> None:
    (row,) = judge_outcomes([outcome("N24", 1.445, values(0.98, ("TRK",), 0.3))], base())
    assert row["detected"]
    assert row["quiet"]
    assert row["falls"]["TRK"] == pytest.approx(68.0, abs=2.0)


def test_a_control_that_changes_nothing_is_not_detected() -> None:
    rows = judge_outcomes([outcome("N24", 1.445, values(0.98))], base())
    assert judge.undetected(rows) == ["N24"]
    assert rows[0]["short"] == {"TRK": (pytest.approx(0.0), 15.0)}


def test_a_control_that_fails_only_by_another_category_is_not_detected() -> None:
    rows = judge_outcomes([outcome("N24", 1.445, values(0.98, ("SEC",), 0.3))], base())
    assert rows[0]["verdict"] == "FAIL"
    assert judge.undetected(rows) == ["N24"]
    assert not rows[0]["quiet"]


def test_a_fall_to_the_cap_of_a_gate_that_newly_fails_is_deep_enough_and_no_other_is() -> None:
    low = values(0.98, ("PAR",), 0.74)  # a circle's, from which 30 points cannot be lost
    scored = scoring.score_all(low)
    assert scored.categories["PAR"] - scoring.GATE_FLOOR < 30.0
    bare = replace(base(), scored=base().scored | {"base": scored}, values=base().values | {"base": low})
    apart = low | {"env_lidar_vs_mesh": values(0.4)["env_lidar_vs_mesh"]}
    (row,) = judge_outcomes([outcome("N31", 0.3, apart)], bare)
    assert row["categories"]["PAR"] == scoring.GATE_FLOOR
    assert row["detected"], row["short"]

    corrupted = base().scored | {"base": scoring.score_all(apart)}
    before = replace(bare, scored=corrupted, values=bare.values | {"base": apart})
    (row,) = judge_outcomes([outcome("N31", 0.3, apart)], before)  # the gate failed without the control already
    assert row["short"] == {"PAR": (0.0, 30.0)}
    gone = low | {"mjx_ray_parity": values(0.0)["mjx_ray_parity"]}
    (row,) = judge_outcomes([outcome("N31", 0.3, gone)], bare)  # it falls, and by no gate
    assert "PAR" in row["short"]
    assert not row["detected"]


def test_a_cheat_is_detected_by_its_leak_alone() -> None:
    rows = judge_outcomes([outcome("N35", 1, values(1.0), ("no noise",)), outcome("N35", 2, values(1.0))], base())
    assert [row["detected"] for row in rows] == [True, False]


def test_growing_doses_give_a_rank_correlation_of_minus_one() -> None:
    doses = [(0.61, 0.9), (0.63, 0.6), (0.66, 0.1)]
    rows = judge_outcomes([outcome("N23", d, values(0.98, ("TRK",), q)) for d, q in doses], base())
    assert rows[0]["spearman"] == pytest.approx(-1.0)


@pytest.mark.parametrize("fraction", [0.965, 0.995])  # by 1.5 points down or up; the global figure moves less
def test_an_invariance_that_moves_a_category_is_loud(fraction: float) -> None:
    rows = judge_outcomes([outcome("I1", 0, values(0.98)), outcome("I4", 0, values(0.98, ("LIN",), fraction))], base())
    assert judge.loud(rows) == ["I4"]


def test_without_any_reference_nothing_is_asked_over_the_null_tube() -> None:
    entries = table.load()
    alone = {id: v if set(entries[id].evidence) <= set("SK") else missing("none") for id, v in values(0.98).items()}
    assert judge.make_judgement({"base": alone, "null": alone}, []).verdict == "PASS"
    assert judge.make_judgement({"base": values(0.98), "null": values(0.98)}, []).verdict == "FAIL"


@pytest.mark.parametrize("id", ["gauge", "gauge_change", "wall"])
def test_a_worst_place_is_written_in_the_unit_of_its_kind(id: str) -> None:
    said = "1.2 cm (limit 1)" if id == "wall" else "12 mm (limit 10)"
    row = {"id": id, "words": id, "where": "", "value": 0.012, "limit": 0.01, "start": 4.0, "end": 6.0, "unit": "m"}
    report = {"windows": {"worst": [{**row, "source": "truth", "beyond": True}]}}
    sheet = SimpleNamespace(case=tube.case(), report=report, note=lambda *_: "")
    drawn = figures.draw_worst_places(sheet)
    assert f"{id}\n{said}, station 4 to 6 m, truth" in drawn[0].axes[0].get_title()
    figures.plt.close(drawn[0])


def test_a_figure_that_cannot_be_drawn_costs_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(sheet: Sheet) -> None:
        raise ValueError("too little of the section")

    fine = lambda sheet: (figures.plt.figure(), "a caption")  # noqa: E731
    monkeypatch.setattr(figures, "FIGURES", (("F00-broken", broken, None), ("F13", fine, None)))
    case = replace(tube.case(), hold=None, truth=None, cache={})
    judgement = judge.make_judgement({"base": values(0.98), "null": values(0.7)}, [])
    write_report(tmp_path, case, Inputs(), judgement, None)
    assert "F00-broken is left out: too little of the section" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"F13.png"}
    page = (tmp_path / "report.html").read_text()
    assert "a caption" in page
    assert "Self-consistency of tube" in page  # nothing to judge by
    assert page.index(judgement.verdict) < page.index("Categories")
    assert 'src="http' not in page


def test_a_run_that_was_cut_short_goes_on_with_the_next_candidate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    def evaluate(one: Case, *rest: object) -> Values:
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(one.candidate.name)
        return values(0.9)

    monkeypatch.setattr(judge, "evaluate", evaluate)
    case = tube.case().fresh()

    def computed() -> dict[str, Values]:
        with judge.open_values(case, tmp_path) as found:
            pass
        return found

    with pytest.raises(KeyboardInterrupt):
        computed()
    first, done = done, []
    found = computed()
    assert first == ["tube", "tube as null tube"]
    assert done == ["truth"]
    assert list(found) == ["base", "null", "ceiling"]
    assert computed() == found
    assert len(done) == 1


def test_controls_are_kept_and_taken_up_again(tmp_path: Path) -> None:
    calls: list[str] = []

    def compute(case: Case, categories: object, reuse: Values) -> Values:
        calls.append(case.candidate.name)
        return reuse

    bench = Bench(tube.case(), values(0.9), tmp_path, None, compute)
    jobs = [Job("N07", 0.1), Job("I6", 0.0)]
    first = run_jobs(bench, jobs, processes=1)
    again = run_jobs(bench, jobs, processes=1)
    assert len(calls) == 2
    assert [o.values for o in again] == [o.values for o in first]
    assert run_control(bench, jobs[0]).job == jobs[0]


# Whoever changes a threshold, weight, gate, limit or row on purpose writes the new digest here, with the reason.
# Last: the words of definitions left it; without them the digest before was the same.
DIGEST = "647d80b8b0611c7592f6c7d6dc50c2a9ffc5814557ba8154d5a70d7411b981bd"


def worst(row: table.Metric) -> Value:
    return Value(0.0 if row.map.kind == "P" else row.map.target + row.map.bad)


def test_a_looser_threshold_and_a_changed_limit_of_the_verdict_change_the_pinned_digest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = dict(table.load())
    with monkeypatch.context() as patch:
        patch.setattr(table, "load", lambda: rows)
        rows["c2m_mean"] = replace(rows["c2m_mean"], definition="Other words.")
        assert judge.constants_digest() == DIGEST
        rows["c2m_mean"] = replace(rows["c2m_mean"], map=replace(rows["c2m_mean"].map, bad=1.0))
        assert judge.constants_digest() != DIGEST
    monkeypatch.setattr(scoring, "PASS_GLOBAL", 80.0)
    assert judge.constants_digest() != DIGEST


@pytest.mark.parametrize("gate", [id for id, row in table.load().items() if row.role == "G"])
def test_a_failed_gate_caps_its_category_and_fails_the_verdict(gate: str) -> None:
    rows, perfect = table.load(), values(1.0)
    category = rows[gate].category
    assert scoring.score_all(perfect).categories[category] == 100.0
    scored = scoring.score_all(perfect | {gate: worst(rows[gate])})
    assert scored.categories[category] == 50.0
    assert scored.failed_gates == (gate,)
    reasons = scoring.reasons_against(scored, None, None, [], [], [])
    assert any(reason.startswith(f"gate {gate} failed") for reason in reasons)
    assert f"category {category} is 50.0, below 70" in reasons


@pytest.mark.parametrize("name", table.CATEGORIES)
def test_a_category_is_scored_while_at_most_thirty_per_cent_of_it_are_missing(name: str) -> None:
    rows, perfect = table.load(), values(1.0)
    own = [id for id, row in rows.items() if row.category == name]
    scored = [id for id in own if rows[id].scored]
    most = int(0.3 * len(scored) + 1e-9)
    for count, score in ((most, 100.0), (most + 1, None)):
        found = scoring.score_all(perfect | dict.fromkeys(scored[:count], missing("none")))
        assert found.categories[name] == score


def test_a_ladder_ends_at_the_smallest_size_that_is_noticed(tmp_path, monkeypatch) -> None:
    case, rows = tube.case(tube.Tube(length=24.0), beams=60), []
    monkeypatch.setattr(ladder, "worst_windows", lambda case: [])
    monkeypatch.setattr(ladder, "put_in", lambda site, fault: fault)
    for least in (0, 1, 7, 11, 12, 13, 15, 16):
        sizes = {kind: np.append(ladder.rungs(kind), np.inf)[least] for kind in ladder.asked_faults()}
        monkeypatch.setattr(ladder, "noticed_by", lambda one, _, sizes=sizes: (
            ("w",) if abs(one.size) > 0.99 * sizes[one.kind] else ()))  # fmt: skip
        found = ladder.climb_ladders(case, (), 3, least, tmp_path)
        assert {row["rung"] for row in found} == {least}
        rows += found
    asked = ladder.asked_faults()
    for row in rows:
        assert 4.0 <= row["start"] <= 20.0 - row["length"] == 20.0 - asked[row["kind"]].length
        assert abs(row["tried"][0]["size"]) == abs(row["size"]) == asked[row["kind"]].size
        assert len(row["tried"]) <= 5
    assert {(row["kind"], np.sign(row["size"]), row["side"]) for row in rows if row["kind"] in ("wall", "roof")} == {
        ("wall", 1, 0.0), ("wall", 1, np.pi), ("wall", -1, 0.0), ("wall", -1, np.pi), ("roof", 1, np.pi / 2),
        ("roof", -1, np.pi / 2)}  # fmt: skip
    monkeypatch.setattr(ladder, "noticed_by", lambda *_: pytest.fail("done already"))
    again = ladder.climb_ladders(case, (), 3, 16, tmp_path)
    assert [(row["kind"], row["number"], row["rung"]) for row in again] == [
        (row["kind"], row["number"], row["rung"]) for row in found]  # fmt: skip


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
