"""The frozen constants: a gate that caps, thresholds that nobody loosens unseen, and every metric named by a test."""

from dataclasses import replace

import pytest

from benchmarks.fidelity import judge, scoring, table
from benchmarks.fidelity.registry import Value, missing

# Whoever changes a threshold, weight, gate, limit or row on purpose writes the new digest here, with the reason.
# Last: the sweep over thresholds left, and its limits with it; maps, gates and limits of the verdict are the same.
DIGEST = "5272174c7c16f487b95544015de1cd7c6147995d6c2a69b41a14f110a62cabc3"


def ideal(row: table.Metric) -> Value:
    return Value(1.0 if row.map.kind == "P" else row.map.target if row.map.kind == "B" else row.map.good)


def worst(row: table.Metric) -> Value:
    return Value(0.0 if row.map.kind == "P" else row.map.target + row.map.bad)


def test_the_frozen_constants_are_the_pinned_ones() -> None:
    assert judge.constants_digest() == DIGEST


def test_a_looser_threshold_and_a_changed_limit_of_the_verdict_change_the_digest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = dict(table.load())
    rows["c2m_mean"] = replace(rows["c2m_mean"], map=replace(rows["c2m_mean"].map, bad=1.0))
    with monkeypatch.context() as patch:
        patch.setattr(table, "load", lambda: rows)
        assert judge.constants_digest() != DIGEST
    monkeypatch.setattr(scoring, "PASS_GLOBAL", 80.0)
    assert judge.constants_digest() != DIGEST


@pytest.mark.parametrize("gate", [id for id, row in table.load().items() if row.role == "G"])
def test_a_failed_gate_caps_its_category_and_fails_the_verdict(gate: str) -> None:
    rows = table.load()
    perfect = {id: ideal(row) for id, row in rows.items()}
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
    rows = table.load()
    perfect, own = {id: ideal(row) for id, row in rows.items()}, [i for i, r in rows.items() if r.category == name]
    scored = [id for id in own if rows[id].scored]
    most = int(0.3 * len(scored) + 1e-9)
    for count, score in ((most, 100.0), (most + 1, None)):
        found = scoring.score_all(perfect | dict.fromkeys(scored[:count], missing("none")))
        assert found.categories[name] == score
