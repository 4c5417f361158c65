"""The leaderboard: what it refuses, what it keeps, what it says."""

import dataclasses
import json
import re
import sys

import numpy as np
import pytest

from benchmarks.leaderboard import __main__ as command
from benchmarks.leaderboard import entries as entry_module
from benchmarks.leaderboard import figure, report
from benchmarks.leaderboard.board import scores, totals
from benchmarks.leaderboard.config import LeaderboardConfig, agents_for, checked
from benchmarks.leaderboard.entries import Entry
from subterra_jax.baselines import registry
from subterra_jax.evaluation import Records
from subterra_jax.evaluation.episodes import SHA256

FACTS = {"episodes": 100, "device": "a processor", "jax": "0"}


def run(monkeypatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["leaderboard", *arguments])
    return command.main()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--tasks", "Fly"), "error: no task 'Fly'; there are Subterra/Traverse-v0"),
        (("--agents", "nobody"), "error: no agent 'nobody'; there are random"),
        (("--episodes", "501"), "error: episodes must be at most 500, got 501"),
        (("--batch", "0"), "error: batch must be at least 1, got 0"),
        (("--tunnels", "no.npz"), "error: no.npz: no such tunnel file"),
        (("--agents", "policy:Fly-v0"), "error: no agent 'policy:Fly-v0'; there are random"),
        (("--tasks", "Relocalise", "--agents", "policy:StopAt-v0"), "error: policy:StopAt-v0: a policy that drives to"),
        (("--linings", "velvet"), "error: tunnel 'subterra-351' has no lining 'velvet'"),
    ],
)
def test_what_cannot_be_had_is_one_sentence_and_status_2(monkeypatch, capsys, tmp_path, arguments, sentence):
    assert run(monkeypatch, *arguments, "--out", str(tmp_path / "out")) == 2
    told = capsys.readouterr().err
    assert told.startswith(sentence)
    assert told.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_where_no_agent_is_named_the_policy_released_for_the_task_drives_beside_the_baselines():
    config = checked(LeaderboardConfig(tasks=("TraverseShort", "RelocaliseShort")))
    with_policy, without = (agents_for(config, task) for task in config.tasks)
    assert set(with_policy) - set(without) == {"released-policy"}
    assert {"ring-count", "particle-filter", "oracle"} <= set(without)
    # What a robot on legs has learnt does not drive the planar one.
    assert "policy:StopAt-v0" in registry.names()
    assert not any(name.startswith("policy:B2") for name in registry.names())


def test_what_was_driven_is_kept_and_read_by_the_next_run(monkeypatch, tmp_path):
    wanted = ("--tasks", "TraverseShort", "--agents", "random", "--episodes", "4", "--out", str(tmp_path))
    assert run(monkeypatch, *wanted) == 0
    files = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert {path.name for path in files} >= {"leaderboard.md", "leaderboard.json", "leaderboard.png"}
    assert SHA256 in (tmp_path / "leaderboard.md").read_text()
    board = json.loads((tmp_path / "leaderboard.json").read_text())
    assert board["scores"][0]["success"] == 0.0
    assert board["scores"][0]["episodes"] == 4

    def driven(*arguments):
        raise AssertionError("driven again")

    monkeypatch.setattr(entry_module, "evaluate", driven)
    assert run(monkeypatch, *wanted) == 0
    entry = next(path for path in files if path.parent.name == "entries")
    assert entry.read_bytes() == files[entry]
    # Other episodes are another entry, and a damaged one is none.
    with pytest.raises(AssertionError, match="driven again"):
        run(monkeypatch, *wanted[:4], "--episodes", "5", "--out", str(tmp_path))
    entry.write_bytes(files[entry][:-20])
    with pytest.raises(AssertionError, match="driven again"):
        run(monkeypatch, *wanted)


def entry(task: str, agent: str, successes: int) -> Entry:
    """100 episodes in 10 groups, the successes evenly among the groups; nothing else measured."""
    columns = {field.name: np.full(100, np.nan) for field in dataclasses.fields(Records)}
    columns |= {name: np.zeros(100, int) for name in ("seed", "tunnel", "severity")}
    index = np.arange(100)
    columns |= {"group": index // 10, "success": index % 10 < successes // 10, "contact": np.zeros(100, bool)}
    columns["travelled"] = np.full(100, 10.0)
    traits = {"uses_lidar": True, "uses_map": False, "privileged": agent == "oracle"}
    bounds = {"command": 0.2, "odometry": 0.25, "fused": 0.3} if task == "Subterra/StopAt-v0" else None
    return Entry(task, "a tunnel, smooth", agent, traits, Records(**columns), bounds)


@pytest.fixture
def entries():
    percent = {"dead-reckoning": (20, 100), "oracle": (100, 100), "filter": (60, 100)}
    return [
        entry(task, agent, both[i])
        for agent, both in percent.items()
        for i, task in enumerate(("Subterra/StopAt-v0", "Subterra/Traverse-v0"))
    ]


def test_an_agent_half_way_between_dead_reckoning_and_the_oracle_scores_a_half(entries):
    rows = {(row["agent"], row["task"]): row for row in scores(entries)}
    assert rows["filter", "Subterra/StopAt-v0"]["normalised"] == pytest.approx(0.5)
    # Where dead reckoning is as good as the oracle there is nothing to tell.
    assert rows["filter", "Subterra/Traverse-v0"]["normalised"] is None
    overall = {row["agent"]: row for row in totals(entries)}
    assert overall["filter"]["normalised_iqm"] == pytest.approx(0.5)
    assert overall["oracle"]["normalised_iqm"] == pytest.approx(1.0)
    assert overall["dead-reckoning"]["tasks"] == 1
    assert [row["agent"] for row in totals(entries)] == ["oracle", "filter", "dead-reckoning"]


def test_without_dead_reckoning_or_the_oracle_nothing_is_normalised(entries):
    alone = [e for e in entries if e.agent == "filter"]
    assert all(row["normalised"] is None for row in scores(alone))
    assert totals(alone) == []


def test_the_report_names_the_list_and_shows_every_agent_with_its_interval(entries):
    rows, overall = scores(entries), totals(entries)
    text = report.as_markdown(rows, overall, FACTS)
    assert SHA256 in text
    # 100 draws of six in ten: ± 1.96 × 4.9 points.
    assert re.search(r"\| filter \| LiDAR \| 60\.0 \(5[01]-(69|70)\) \| 100\.0 \(100-100\) \|", text)
    assert "| oracle | truth |" in text
    assert "| filter | 0.500 | 0.500 to 0.500 | 1 |" in text
    assert text.count("20.0 % from commands, 25.0 % from odometry, 30.0 % from both") == 1
    assert json.loads(report.as_json(rows, overall, FACTS))["evaluation_sha256"] == SHA256
    assert len(figure.draw(rows, FACTS).axes) == 2
