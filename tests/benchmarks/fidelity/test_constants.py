"""The frozen constants: a gate that caps, thresholds that nobody loosens unseen, and every metric named by a test."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.fidelity import judge, scoring, table
from benchmarks.fidelity.registry import Value

# Whoever changes a threshold, weight, gate, limit or row on purpose writes the new digest here, with the reason.
# Last: voxels that few beams decide are left out, normals come from as many beams of each scan; floors of both anew.
DIGEST = "a5d415c1badf688e4f5a4f6e30aca94a0d367c7bb3fc139b4c4daa63f29467cc"
TESTS = Path(__file__).parent


def ideal(row: table.Metric) -> Value:
    return Value(1.0 if row.map.kind == "P" else row.map.target if row.map.kind == "B" else row.map.good)


def worst(row: table.Metric) -> Value:
    return Value(0.0 if row.map.kind == "P" else row.map.target + row.map.bad)


def test_the_frozen_constants_are_the_pinned_ones() -> None:
    assert judge.constants_digest() == DIGEST


@pytest.mark.parametrize("id", [id for id, row in table.load().items() if row.map.kind in "DUB"])
def test_a_threshold_ten_times_looser_changes_the_digest(id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = dict(table.load())
    rows[id] = replace(rows[id], map=replace(rows[id].map, bad=10.0 * rows[id].map.bad))
    monkeypatch.setattr(table, "load", lambda: rows)
    assert judge.constants_digest() != DIGEST


@pytest.mark.parametrize("name", [name for name in vars(scoring) if name.isupper()])
def test_a_changed_limit_of_the_verdict_changes_the_digest(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scoring, name, "another")
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


def test_every_metric_is_named_by_a_test() -> None:
    text = "\n".join(file.read_text() for file in TESTS.glob("test_*.py"))
    assert [id for id in table.load() if not re.search(rf"\b{id}\b", text)] == []
