"""The board: its columns, its resumption, its table of a screen, and that a figure beyond a bound is named."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import subterra_jax as st
from benchmarks.board import __main__ as command
from benchmarks.board import cells, columns, drive, roster, tables
from benchmarks.board.__main__ import records_of
from benchmarks.board.columns import OWN, Column, Setting
from benchmarks.board.drive import BoardConfig, Job
from benchmarks.command import BenchmarkError
from benchmarks.records import read_records
from subterra_jax.episode import Driver
from subterra_jax.evaluation import harness
from subterra_jax.evaluation.floor import floor
from tests.recorded import check, drawn, lines_of

VALUES = Path(__file__).with_name("values.csv")
SPLITS = ("val", "test-unseen")
PLANAR = roster.PLANAR


def cell(agent, success, task="StopAt", n=40, floor=0.3, splits=("val",), hidden=False):
    """A cell of one kind in some splits."""
    hits = [1] * round(n * success)
    return {
        "schema": cells.SCHEMA,
        "conditions": "x",
        "task": task,
        "hidden_start": hidden,
        "agent": agent,
        "columns": [{"kind": "cast", "split": split} for split in splits],
        "tunnels": 2,
        "success": (hits + [0] * (n - len(hits))) * len(splits),
        "contact": [0] * n * len(splits),
        "goal_error": ([0.5] * (n - 1) + [None]) * len(splits),
        "floor": [floor, floor] * len(splits),
        "facts": {"constants_sha256": "0" * 64, "device": "none", "platform": "none", "date": "2026-11-26T00:00"},
    }


def test_kernels_are_chosen_by_rule_beside_what_a_user_asks_of_the_compiler(monkeypatch):
    for given, asked in (("--a=1", "--a=1 --xla_gpu_autotune_level=0"), (f := "--xla_gpu_autotune_level=4", f)):
        monkeypatch.setenv("XLA_FLAGS", given)
        drive.choose_by_rule()
        assert drive.os.environ["XLA_FLAGS"] == asked


def test_a_column_has_its_own_tunnels_and_a_split_its_own_seeds():
    some = columns.columns_of(SPLITS, ("control",))
    assert len(some) == 11
    names = columns.tunnel_names(some, 2)
    assert names[:2] == ["open:straight:val:100", "open:straight:val:101"]
    assert names[-2].startswith("open:rock:test-unseen:")
    assert names[-1] == "control"
    found = columns.draw_episodes(Setting("Faulted"), some, 2, 20, faults=True)
    for place, column in enumerate(some[:-1]):
        rows = slice(20 * place, 20 * place + 20)
        assert {names[i].rsplit(":", 1)[0] for i in found.tunnel[rows]} == {f"open:{column.kind}:{column.split}"}
        assert np.bincount(found.severity[rows]).tolist() == [4] * 5
    assert set(found.tunnel[-20:]) == {20}
    assert not set(found.seed[:20]) & set(found.seed[180:200])
    np.testing.assert_array_equal(found.seed[:20], found.seed[20:40])
    assert found.seed.max() < 2**30, "a listed episode lies above"
    hidden = columns.draw_episodes(Setting("Faulted", True), some, 2, 20, faults=True)
    assert not set(found.seed) & set(hidden.seed)


def test_the_seeds_of_the_cells_on_record_are_still_drawn():
    found = columns.draw_episodes(Setting("StopAt", True), (Column("cast", "val"),), 5, 50, faults=False)
    assert found.seed[:3].tolist() == [880160946, 855418373, 572588487]


def test_figures_beyond_a_bound_are_named_and_others_are_not():
    fair = [cell("fused", 0.4), cell("scan-matching", 0.9), cell("ceiling", 0.95), cell("oracle", 1.0)]
    assert cells.find_leaks(fair) == []
    assert "fused, StopAt, cast of val: 100 % is above the floor" in cells.find_leaks([cell("fused", 1.0)])[0]
    above = cells.find_leaks([cell("scan-matching", 1.0), cell("ceiling", 0.5)])
    assert above == ["scan-matching, StopAt, cast of val: 100 % is above the ceiling, 50 %"]


def test_pages_records_and_picture_of_a_board_are_those_of_the_table():
    both, rng = {"splits": SPLITS}, np.random.default_rng(5)
    names = (
        "fused",
        "scan-matching",
        "locate-transformer",
        "StopAt-plain",
        "locate-map",
        "ceiling",
        "oracle",
        "mine.py:Own",
    )
    some = [cell(name, 0.1 * k + 0.2, **both) for k, name in enumerate(names)]
    some += [cell("fused", 0.2, hidden=True, **both), cell("ceiling", 0.3, "Return", splits=("test-unseen",))]
    some += [cell("fused", 0.9, "Mine/Own-v1", floor=None) | {"texture": 0.5}, cell("random", 0.0, "Return", **both)]
    for one in some:
        one["goal_error"] = [None if x < 0.1 else x for x in rng.random(len(one["success"])).round(3).tolist()]
        one["contact"] = rng.integers(0, 2, len(one["success"])).tolist()
        one["floor"] = None if one["floor"][0] is None else rng.random(len(one["floor"])).round(3).tolist()
    some[0]["columns"].append({"kind": "control", "split": OWN})
    some[0] |= {name: some[0][name] + some[0][name][:40] for name in ("success", "contact", "goal_error")}
    some[0]["floor"].append(0.25)
    pages = {"all": tables.as_markdown(some), "none": tables.screen_markdown([cell("fused", 0.4)])}
    pages |= {split: tables.kinds_markdown(some, split) for split in SPLITS}
    picture = {split: drawn(tables.draw(some, split)) for split in (*SPLITS, "test-seen")}
    check(VALUES, "board", {"pages": pages, "picture": picture, "records": lines_of(records_of(some))})


def test_the_best_of_a_group_is_chosen_on_val_and_not_where_it_is_shown():
    good_on_val, good_on_test = cell("scan-matching", 0.0, splits=SPLITS), cell("fused", 0.0, splits=SPLITS)
    good_on_val["success"] = [1] * 40 + [0] * 40
    good_on_test["success"] = [0] * 40 + [1] * 40
    row = tables.screen([good_on_val, good_on_test])[0]
    agent, score = row["best written"]
    assert (agent, score.success) == ("scan-matching", 0.0)
    assert row["learnt"] is None


def test_a_cell_of_some_of_the_splits_stands_where_it_was_driven():
    wide, narrow = cell("fused", 0.4, splits=SPLITS), cell("ceiling", 0.9, splits=("test-unseen",))
    text = tables.as_markdown([narrow, wide])
    assert text.index("## val by kind") < text.index("## test-unseen by kind") < text.index("| *ceiling* |")
    assert text.count("| *ceiling* |") == 1
    above = cells.find_leaks([narrow, {**wide, "agent": "scan-matching", "success": [1] * 80}])
    assert above == []
    narrow = {**narrow, "success": [0] * 40}
    above = cells.find_leaks([narrow, {**wide, "agent": "scan-matching", "success": [1] * 80}])
    assert above == ["scan-matching, StopAt, cast of test-unseen: 100 % is above the ceiling, 0 %"]


def test_who_does_the_same_in_every_kind_has_the_interval_of_one_kind():
    blind = cell("fused", 0.5, splits=("val", "val"))
    blind["columns"][1] = {"kind": "rock", "split": "val"}
    one, both = (cells.summarise(blind, keys) for keys in ({("val", "cast")}, {("val", "cast"), ("val", "rock")}))
    assert (both.low, both.high, both.n) == (one.low, one.high, 2 * one.n)
    half = len(blind["success"]) // 2
    blind["success"][half:] = [1 - value for value in blind["success"][half:]]
    assert cells.summarise(blind, {("val", "cast"), ("val", "rock")}).high == 0.5


def test_columns_of_different_numbers_of_tunnels_are_summed_up_by_their_own():
    mixed = cell("fused", 0.5, splits=SPLITS)
    mixed["columns"][1] = {"kind": "mine", "split": OWN}
    mixed["floor"] = [0.2, 0.4, 0.9]
    assert cells.summarise(mixed, {("val", "cast")}).floor == pytest.approx(0.3)
    assert cells.summarise(mixed, {(OWN, "mine")}).floor == pytest.approx(0.9)
    assert cells.summarise(mixed, {("val", "rock")}) is None


def test_conditions_of_parts_are_those_of_every_choice_of_splits_and_sensors(tmp_path):
    config = BoardConfig(tmp_path, splits=SPLITS)
    found = drive.conditions_of_parts(config)
    assert drive.conditions(config, PLANAR) in found
    assert drive.conditions(BoardConfig(tmp_path, splits=("test-unseen",)), "spin16x64") in found
    assert drive.conditions(BoardConfig(tmp_path, splits=SPLITS, episodes=7), PLANAR) not in found
    assert drive.conditions(BoardConfig(tmp_path, splits=SPLITS, further=("control",)), PLANAR) not in found


def test_all_cells_on_record_are_of_todays_constants():
    path = Path(cells.__file__).parent / "cells.jsonl"
    kept = cells.read_cells(path, drive.conditions_of_parts(BoardConfig(path)))
    assert len(kept) == len(path.read_text().splitlines())
    assert cells.find_leaks(kept) == []


def test_agents_drive_the_tasks_that_they_are_for_unless_they_are_named(tmp_path):
    jobs = drive.jobs_of(BoardConfig(tmp_path, ("StopAt", "Relocalise")))
    assert Job(Setting("StopAt", True), "fused", PLANAR) in jobs
    assert Job(Setting("StopAt"), "locate-spin", "spin16x64") in jobs
    assert not [job for job in jobs if job.agent == "locate-transformer" and job.setting != Setting("StopAt")]
    assert not [job for job in jobs if job.setting == Setting("Relocalise", True)]
    named = drive.jobs_of(BoardConfig(tmp_path, ("StopAt",), "hidden", ("locate-transformer",)))
    assert named == [Job(Setting("StopAt", True), "locate-transformer", PLANAR)]


def test_a_policy_with_a_map_drives_from_a_hidden_start_with_it_and_without(tmp_path):
    for job in drive.jobs_of(BoardConfig(tmp_path, ("StopAt",), "hidden", ("locate-map", "nomap:locate-map"))):
        env, params = drive.enter(job, "control")
        assert params.start.station_sigma > 0.0
        agent = roster.make_agent(job.agent, env, params)
        assert agent.uses_map == (job.agent == "locate-map")


def test_an_agent_without_a_map_of_its_own_cannot_be_driven_without_one():
    env, params = st.make("Subterra/StopAt-v1", tunnel="control")
    with pytest.raises(BenchmarkError, match="nomap:locate-transformer: locate-transformer has no map to go without"):
        roster.make_agent("nomap:locate-transformer", env, params)
    with pytest.raises(BenchmarkError, match="cut:fused: fused has no walls to go without"):
        roster.make_agent("cut:fused", env, params)


def test_a_cell_that_is_there_is_not_driven_again(tmp_path, monkeypatch):
    config = BoardConfig(tmp_path, ("StopAt",), "given", ("fused",), ("val",), 40, 2)
    job = Job(Setting("StopAt"), "fused", PLANAR)
    there = {**cell("fused", 0.4), "conditions": drive.conditions(config, PLANAR), "policy": None}
    drive.cell_file(config, job).parent.mkdir()
    drive.cell_file(config, job).write_text(json.dumps(there))
    monkeypatch.setattr(drive, "evaluate", None)
    command.run(config)
    assert (tmp_path / "board.png").exists()
    assert {record.id for record in read_records(tmp_path / "records.json")} == {"board/StopAt/val/fused"}
    with pytest.raises(st.SubterraError, match="holds no cell"):
        command.run(BoardConfig(**{**vars(config), "episodes": 41, "report_only": True}))
    drive.cell_file(config, job).write_text(json.dumps({**there, "policy": "other weights"}))
    assert not drive.is_there(config, job)


def test_what_is_driven_in_parts_is_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(drive, "columns_of", lambda splits, further: (Column("cast", "val"),))
    monkeypatch.setattr(drive, "fitting_batch", lambda env, params, agent, most, memory: min(most, int(memory)))
    parts, begin = [], Driver.begin
    monkeypatch.setattr(
        Driver, "begin", lambda self, p, a, seed, *rest: parts.append(len(seed)) or begin(self, p, a, seed, *rest)
    )
    found, job = {}, Job(Setting("StopAtShort"), "dead-reckoning", PLANAR)
    for memory in (12.0, 4.0):
        out = tmp_path / str(memory)
        config = BoardConfig(out, ("StopAtShort",), "given", (job.agent,), ("val",), 12, 1, memory=memory)
        command.run(config)
        found[memory] = json.loads(drive.cell_file(config, job).read_text())
    assert parts == [12, 4, 4, 4]
    whole, some = found.values()
    for name in ("success", "contact", "floor"):
        assert whole[name] == some[name], name
    np.testing.assert_allclose(whole["goal_error"], some["goal_error"], atol=0.002)


def test_a_batch_takes_no_more_than_the_memory_that_it_may_unless_it_is_one_episode(monkeypatch):
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="control", estimates=True)
    monkeypatch.setattr(Driver, "bytes_needed", lambda self, params, agent, n, n_steps: 1e6 * (n + 3))
    found = [harness.fitting_batch(env, params, None, 64, memory) for memory in (0.067, 0.03, 0.0045, 1e-9)]
    assert found == [64, 27, 1, 1]


def test_a_task_without_slip_or_to_cover_the_tunnel_has_no_floor():
    _, params = st.make("Subterra/StopAtShort-v1", tunnel="control")
    assert drive.floors_of(params, 1) == [round(floor(params, 0), 4)]
    plain = SimpleNamespace(goal_kind=params.goal_kind, parts={})
    assert drive.floors_of(plain, 1) is drive.floors_of(st.make("Subterra/TraverseShort-v1", "control")[1], 1) is None
