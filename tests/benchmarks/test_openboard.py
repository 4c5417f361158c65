"""The leaderboard of version 1: its columns, its resumption, and that a figure beyond a bound is named."""

import json
import operator

import jax
import numpy as np
import pytest

import subterra_jax as st
from benchmarks.openboard import __main__ as command
from benchmarks.openboard import ablations, bound, columns, report, search
from subterra_jax.baselines import registry
from subterra_jax.episode import Driver
from subterra_jax.evaluation import harness

SPLITS = ("val", "test-unseen")
LITTLE = 1.2e-5  # GB; some episodes, not a dozen


def cell(agent, success, task="StopAt", n=40, floor=0.3):
    """A cell of one column."""
    hits = [1] * round(n * success)
    return {
        "schema": columns.SCHEMA,
        "conditions": "x",
        "task": task,
        "agent": agent,
        "columns": [{"kind": "cast", "split": "val"}],
        "tunnels": 2,
        "success": hits + [0] * (n - len(hits)),
        "contact": [0] * n,
        "goal_error": [0.5] * (n - 1) + [None],
        "floor": [floor, floor],
        "facts": {"constants_sha256": "0" * 64, "device": "none"},
    }


def test_a_column_has_its_own_tunnels_and_a_split_its_own_seeds():
    some = columns.columns_of(SPLITS)
    assert len(some) == 10
    names = columns.tunnel_names(some, 2)
    assert names[:2] == ["open:straight:val:100", "open:straight:val:101"]
    assert names[-1].startswith("open:rock:test-unseen:")
    found = columns.draw_episodes("Faulted", some, 2, 20)
    for place, column in enumerate(some):
        rows = slice(20 * place, 20 * place + 20)
        assert {names[i].rsplit(":", 1)[0] for i in found.tunnel[rows]} == {f"open:{column.kind}:{column.split}"}
        assert np.bincount(found.severity[rows]).tolist() == [4] * 5
    assert not set(found.seed[:20]) & set(found.seed[-20:])
    np.testing.assert_array_equal(found.seed[:20], found.seed[20:40])
    assert found.seed.max() < 2**30, "a listed episode lies above"


def test_figures_beyond_a_bound_are_named_and_others_are_not():
    fair = [cell("fused", 0.4), cell("ring-filter", 0.9), cell("ceiling", 0.95)]
    assert report.find_leaks(fair) == []
    assert "fused, StopAt, cast of val: 100 % is above the floor" in report.find_leaks([cell("fused", 1.0)])[0]
    above = report.find_leaks([cell("ring-filter", 1.0), cell("ceiling", 0.5)])
    assert above == ["ring-filter, StopAt, cast of val: 100 % is above the ceiling, 50 %"]


def test_a_table_and_a_picture_hold_every_agent(tmp_path):
    cells = [cell("fused", 0.4), cell("ring-filter", 0.9), cell("ceiling", 0.95)]
    text = report.as_markdown(cells)
    assert "| floor, in theory | | 30 |" in text
    assert "| ring-filter | `subterra-351`, older family | 90 (" in text
    assert report.as_png(cells)[:4] == b"\x89PNG"


def test_a_cell_of_some_of_the_splits_stands_where_it_was_driven():
    wide = {**cell("fused", 0.4, n=80), "columns": [{"kind": "cast", "split": s} for s in SPLITS], "floor": [0.3] * 4}
    narrow = {**cell("ceiling", 0.9), "columns": [{"kind": "cast", "split": "test-unseen"}]}
    text = report.as_markdown([narrow, wide])
    assert text.index("### StopAt, val") < text.index("### StopAt, test-unseen") < text.index("| ceiling |")
    assert text.count("| ceiling |") == 1
    assert report.as_png([narrow, wide])[:4] == b"\x89PNG"
    above = report.find_leaks([narrow, {**wide, "agent": "ring-filter", "success": [1] * 80}])
    assert above == []
    narrow = {**narrow, "success": [0] * 40}
    above = report.find_leaks([narrow, {**wide, "agent": "ring-filter", "success": [1] * 80}])
    assert above == ["ring-filter, StopAt, cast of test-unseen: 100 % is above the ceiling, 0 %"]


def test_conditions_of_parts_are_those_of_every_choice_of_splits(tmp_path):
    config = command.OpenboardConfig(tmp_path, splits=SPLITS)
    found = command.conditions_of_parts(config)
    assert len(found) == 3
    assert command.conditions(config) in found
    assert command.conditions(command.OpenboardConfig(tmp_path, splits=("test-unseen",))) in found


def test_a_cell_that_is_there_is_not_driven_again(tmp_path, monkeypatch, capsys):
    config = command.OpenboardConfig(tmp_path, ("StopAt",), ("fused",), ("val",), 40, 2)
    there = {**cell("fused", 0.4), "conditions": command.conditions(config)}
    command.cell_file(config, "StopAt", "fused").parent.mkdir()
    command.cell_file(config, "StopAt", "fused").write_text(json.dumps(there))
    monkeypatch.setattr(command, "evaluate", None)
    command.run(config)
    assert (tmp_path / "openboard.png").exists()
    changed = command.OpenboardConfig(tmp_path, ("StopAt",), ("fused",), ("val",), 41, 2)
    with pytest.raises(st.SubterraError, match="holds no cell"):
        command.run(command.OpenboardConfig(**{**vars(changed), "report_only": True}))


def test_an_agent_that_needs_more_memory_is_driven_in_parts_of_the_same_episodes(tmp_path, monkeypatch):
    monkeypatch.setattr(columns, "columns_of", lambda splits: (columns.Column("cast", "val"),))
    parts = []
    begin = Driver.begin
    monkeypatch.setattr(
        Driver, "begin", lambda self, p, a, seed, *rest: parts.append(seed) or begin(self, p, a, seed, *rest)
    )
    found = {}
    for memory in (8.0, LITTLE):
        out = tmp_path / str(memory)
        config = command.OpenboardConfig(out, ("StopAtShort",), ("dead-reckoning",), ("val",), 12, 1, memory=memory)
        command.run(config)
        found[memory] = json.loads(command.cell_file(config, "StopAtShort", "dead-reckoning").read_text())
    whole, *some = parts
    assert len(whole) == 12
    assert 1 < len(some) < 12
    assert set(np.concatenate(some).tolist()) == set(whole.tolist())
    for name in ("success", "contact", "floor"):
        assert found[8.0][name] == found[LITTLE][name], name
    np.testing.assert_allclose(found[8.0]["goal_error"], found[LITTLE]["goal_error"], atol=0.002)


def test_a_batch_takes_no_more_than_the_memory_that_it_may_unless_it_is_one_episode():
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="control", estimates=True)
    agent = registry.make_agent("dead-reckoning", params)
    driver = harness._prepare(env, params, agent)[2]
    needed = driver.bytes_needed(params, agent, 64, harness._CHUNK)
    assert needed > driver.bytes_needed(params, agent, 16, harness._CHUNK) > 0
    assert harness.fitting_batch(env, params, agent, 64, needed * 1e-9) == 64
    least = harness.fitting_batch(env, params, agent, 64, 0.4e-9 * needed)
    assert 1 < least < 40
    assert driver.bytes_needed(params, agent, least, harness._CHUNK) <= 0.4 * needed
    assert harness.fitting_batch(env, params, agent, 64, 1e-9) == 1


@pytest.mark.parametrize("agent", search.SPACES)
def test_a_search_begins_with_the_default_and_keeps_it_unless_another_is_clearly_better(agent):
    _, params = st.make("Subterra/StopAt-v1", tunnel="control")
    first, *others = search.candidates(agent)
    at = operator.attrgetter(search.SPACES[agent][0])
    default = at(registry.make_agent(agent, params))
    for name, value in first.items():
        assert getattr(default, name) == pytest.approx(value), name
    made = at(search.with_settings(agent, others[-1])(params))
    assert {name: getattr(made, name) for name in first} == others[-1]
    rows = [{"settings": s, "success": x} for s, x in ((first, 0.5), (others[0], 0.52), (others[1], 0.51))]
    assert search.choose(rows, 400) == first
    rows[1]["success"] = 0.6
    assert search.choose(rows, 400) == others[0]


def test_an_ablation_of_wet_rail_has_its_loss_in_every_episode():
    part = ablations.WetRail(factor=4.0 / 3.0)
    env, params = st.make("Subterra/Faulted-v1", tunnel="control")
    drawn = env.draw_reset(jax.random.key(0), (), params)
    state = env.begin(drawn, params)
    loss = part.sizes(part.begin(drawn["faults"], state, params), params).wet_loss
    assert float(loss) == pytest.approx(0.4)


def test_bound_and_error_are_compared_where_the_bound_is_tight():
    row = {"tunnel": "x", "station": [1.0, 2.0, 3.0], "bound": [0.1, 0.1, 1.0], "error": [0.12, 0.12, 9.0]}
    assert bound.ratio(row) == pytest.approx(1.2)
    assert "ratio 1.20" in bound.describe(row)
    assert bound.ratio({**row, "bound": [1.0, 1.0, 1.0]}) is None


@pytest.mark.slow
def test_where_the_bound_is_tight_the_ceilings_filter_errs_little_more(tmp_path):
    row = bound.compare("subterra-351:pockets", bound.BoundConfig(tmp_path, episodes=8))
    assert max(row["bound"]) < bound.TIGHT
    assert 0.8 < bound.ratio(row) < 1.3, "1.65 while likelihoods were flattened to spare particles"
