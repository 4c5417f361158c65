"""The leaderboard: what it refuses, what it keeps, what it says."""

import dataclasses
import io
import json
import re
import shutil
import sys
from importlib import resources
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from PIL import Image

import subterra_jax as st
from benchmarks.leaderboard import __main__ as command
from benchmarks.leaderboard import entries as entry_module
from benchmarks.leaderboard import report
from benchmarks.leaderboard.entries import Entry, LeaderboardConfig, agents_for, check
from benchmarks.leaderboard.report import scores, totals
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
        (("--tasks", "Fly"), "error: no task 'Fly'; there are Subterra/Traverse-v1"),
        (("--agents", "nobody"), "error: no agent 'nobody'; there are random"),
        (("--episodes", "501"), "error: episodes must be at most 500, got 501"),
        (("--batch", "0"), "error: batch must be at least 1, got 0"),
        (("--tunnels", "no.npz"), "error: no.npz: no such tunnel file"),
        (("--agents", "policy:Fly-v0"), "error: no agent 'policy:Fly-v0'; there are random"),
        (("--tasks", "Relocalise", "--agents", "policy:Traverse-v1"), "error: policy:Traverse-v1: made for"),
        (("--agents", "policy:mine.safetensors"), "error: mine.safetensors: no such policy"),
        (("--agents", "no.py:Mine"), "error: no.py: cannot be read (No such file or directory)"),
        (("--agents", "nowhere:Mine"), "error: nowhere: No module named 'nowhere'"),
        (("--agents", "json:Mine"), "error: json:Mine: json has no 'Mine'"),
        (("--agents", "pathlib:Path", "--tasks", "TraverseShort"), "error: agent 'pathlib:Path' has no uses_lidar"),
        (("--load", "no.py"), "error: no.py: cannot be read (No such file or directory)"),
        (("--redraw", "no.md"), "error: no.md: cannot be read (No such file or directory)"),
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
    config = check(LeaderboardConfig(tasks=("TraverseShort", "Relocalise")))
    with_policy, without = (agents_for(config, task) for task in config.tasks)
    assert set(with_policy) - set(without) == {"released-policy"}
    assert {"ring-count", "particle-filter", "oracle"} <= set(without)
    # What a robot on legs has learnt does not drive the planar one.
    assert "policy:Traverse-v1" in registry.names()
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
    bounds = {"command": 0.2, "odometry": 0.25, "fused": 0.3} if task == "Subterra/StopAt-v1" else None
    return Entry(task, "a tunnel, smooth", agent, traits, Records(**columns), bounds)


@pytest.fixture
def entries():
    percent = {"dead-reckoning": (20, 100), "oracle": (100, 100), "filter": (60, 100)}
    return [
        entry(task, agent, both[i])
        for agent, both in percent.items()
        for i, task in enumerate(("Subterra/StopAt-v1", "Subterra/Traverse-v1"))
    ]


def test_an_agent_half_way_between_dead_reckoning_and_the_oracle_scores_a_half(entries):
    rows = {(row["agent"], row["task"]): row for row in scores(entries)}
    assert rows["filter", "Subterra/StopAt-v1"]["normalised"] == pytest.approx(0.5)
    # Where dead reckoning is as good as the oracle there is nothing to tell.
    assert rows["filter", "Subterra/Traverse-v1"]["normalised"] is None
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
    assert len(report.draw(rows, FACTS).axes) == 2


def test_a_task_where_an_agent_declares_other_inputs_is_named(entries):
    of_map = {"uses_lidar": True, "uses_map": True, "privileged": False}
    entries[-1] = dataclasses.replace(entries[-1], traits=of_map)
    text = report.as_markdown(scores(entries), totals(entries), FACTS)
    assert "| filter | LiDAR; Traverse: LiDAR, map |" in text
    assert "| dead-reckoning | LiDAR |" in text


def source_of(png: bytes) -> str:
    with Image.open(io.BytesIO(png)) as image:
        return image.info["Source"]


def test_a_figure_drawn_from_the_table_has_the_numbers_of_the_one_drawn_from_the_rows(entries, tmp_path):
    rows = scores(entries)
    path = tmp_path / "leaderboard.md"
    path.write_text(report.as_markdown(rows, totals(entries), FACTS))
    again, facts = report.read_markdown(path)
    assert facts == {"episodes": 100}
    assert source_of(report.as_png(again, facts)) == source_of(report.as_png(rows, FACTS)) == report.figure_digest(rows)
    again[0]["success"] += 0.001
    assert report.figure_digest(again) != report.figure_digest(rows)


def test_the_figure_of_the_documentation_shows_the_numbers_of_its_table():
    docs = Path(__file__).parents[3] / "docs"
    rows, _ = report.read_markdown(docs / "leaderboard.md")
    assert len(rows) > 100
    again = "python -m benchmarks.leaderboard --redraw docs/leaderboard.md"
    assert source_of((docs / "leaderboard.png").read_bytes()) == report.figure_digest(rows), again


MINE = """
import jax.numpy as jnp
from flax import struct

from subterra_jax.baselines import registry


@struct.dataclass
class Standing:
    gain: float = 0.0
    name: str = struct.field(pytree_node=False, default="standing")
    uses_lidar: bool = struct.field(pytree_node=False, default=False)
    uses_map: bool = struct.field(pytree_node=False, default=False)
    privileged: bool = struct.field(pytree_node=False, default=False)

    def begin(self, key, obs, params):
        return jnp.zeros(())

    def act(self, key, memory, obs, params, known):
        return jnp.zeros(5), memory


def of_params(params):
    return Standing(gain=params.vehicle.speed_max)


NAME = None
if NAME:
    registry.register(NAME, lambda params: Standing())
"""


def test_a_users_own_classes_files_and_policies_drive(monkeypatch, tmp_path):
    monkeypatch.setattr(registry, "_FACTORIES", dict(registry._FACTORIES))
    mine, out = tmp_path / "mine.py", tmp_path / "out"
    mine.write_text(MINE)
    (tmp_path / "more.py").write_text(MINE.replace("NAME = None", "NAME = 'standing'"))
    released = resources.files("subterra_jax") / "data" / "policies"
    for ending in (".safetensors", ".json"):
        with resources.as_file(released / f"Traverse-v1{ending}") as path:
            shutil.copy(path, tmp_path / f"weights{ending}")
    agents = (f"{mine}:Standing", f"{mine}:of_params", "standing", f"policy:{tmp_path / 'weights.safetensors'}")
    words = ("--tasks", "Traverse", "--agents", *agents, "--load", str(tmp_path / "more.py"), "--episodes", "2")
    words = (*words, "--out", str(out))
    assert run(monkeypatch, *words) == 0
    rows = {row["agent"]: row for row in json.loads((out / "leaderboard.json").read_text())["scores"]}
    assert set(rows) == set(agents)
    assert [rows[agent]["success"] for agent in agents] == [0.0, 0.0, 0.0, 1.0]
    assert [rows[agent]["uses_lidar"] for agent in agents] == [False, False, False, True]
    # Another file under the same name is another agent.
    before = {path: path.stat().st_mtime_ns for path in (out / "entries").iterdir()}
    mine.write_text(MINE + "\n\nMORE = 1\n")
    assert run(monkeypatch, *words) == 0
    changed = [path.name for path, time in before.items() if path.stat().st_mtime_ns != time]
    assert len(changed) == 2
    assert all("mine_py" in name for name in changed)


TASK = """
from subterra_jax import tasks
from subterra_jax.rules import Traverse

tasks.register("Mine/Cover-v1", Traverse(), horizon=HORIZON, piece=(0.0, 60.0))
"""


def test_a_task_of_a_users_own_file_is_driven_and_driven_again_once_the_file_changes(monkeypatch, tmp_path):
    for known in (st.TASKS, gymnasium.registry):  # puts them back at the end
        monkeypatch.setitem(known, "Mine/Cover-v1", None)
        monkeypatch.delitem(known, "Mine/Cover-v1")
    mine, out = tmp_path / "cover.py", tmp_path / "out"
    words = ("--agents", "dead-reckoning", "--episodes", "2", "--out", str(out))
    for horizon, success in ((450, 1.0), (450, 1.0), (20, 0.0)):
        mine.write_text(TASK.replace("HORIZON", str(horizon)))
        assert run(monkeypatch, *words, "--tasks", f"{mine}:Mine/Cover-v1") == 0
        (row,) = json.loads((out / "leaderboard.json").read_text())["scores"]
        assert (row["task"], row["success"]) == ("Mine/Cover-v1", success)
    assert run(monkeypatch, *words, "--tasks", "Mine/Cover-v1", "--load", str(mine)) == 0
