"""Training of localisers: what is refused, that it learns and goes on, and scores by kind."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import subterra_jax as st
from subterra_jax import policies
from subterra_jax.baselines.agent import observed
from subterra_jax.policies.locate import map_filter, memory
from subterra_jax.policies.locate.agent import flat
from subterra_jax.policies.locate.blocks import Estimate
from subterra_jax.policies.locate.map_strip import MapStrip, map_strip
from subterra_jax.policies.locate.profiles import Points
from subterra_jax.policies.locate.streams import Record
from train import tunnels
from train.checkpoint import iterations
from train.config import ConfigError
from train.folder import RunFolderError
from train.locate import figure, filtering, keeping, look, release, scores, session
from train.locate.command import Command, check
from train.locate.drives import Drive
from train.locate.learner import LocateConfig, LocateLearner, draw_told, map_loss

_SMALL = LocateConfig("gru", n_envs=2, n_steps=200, minibatch=2, chunk=1)


def _command(tmp_path, **changes):
    return Command(out=tmp_path, config=dataclasses.replace(_SMALL, **changes))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"minibatch": 3}, "n_envs = 2 must be a multiple of minibatch = 3"),
        ({"network": "lstm"}, "no network 'lstm'"),
        ({"network": "kalman", "front": "wide"}, "needs the evidence"),
        ({"n_steps": 100}, "n_steps must be at least 200, got 100"),
        ({"minutes": 0.0}, "minutes must be positive"),
        ({"begin_from": "nobody"}, "nobody"),
        ({"begin_from": "Traverse-v1"}, "Traverse-v1: is no localiser"),
        ({"begin_from": "locate-transformer"}, "is of network transformer with front match, not gru"),
        ({"begin_from": "locate-faulted", "network": "transformer"}, "with front wide, not transformer with match"),
        ({"map": True, "network": "kalman"}, "a map is taken by gru, s5, transformer with front match"),
        ({"map": True, "front": "wide"}, "a map is taken by gru, s5, transformer with front match"),
        ({"wrong": 1.0}, "wrong must be at least 0 and below 1"),
        ({"speed": 0.0}, "speed must be above 0 and at most 2.0 m/s, got 0.0"),
        ({"speed": 2.5}, "speed must be above 0 and at most 2.0 m/s, got 2.5"),
    ],
)
def test_settings_that_cannot_be_trained_with_are_refused_by_name(tmp_path, changes, sentence):
    with pytest.raises(ConfigError, match=sentence):
        session.run(_command(tmp_path / "run", **changes))
    assert not (tmp_path / "run").exists()


def test_a_map_of_the_plane_is_not_learnt_with_a_spinning_lidar(tmp_path):
    with pytest.raises(ConfigError, match="a map is of the walls in the plane of planar16; spin16x64 sees others"):
        session.run(dataclasses.replace(_command(tmp_path / "run", map=True), sensor="spin16x64"))


@pytest.mark.parametrize("seeds", [(), (1, 1), (-1,)])
def test_seeds_must_differ(tmp_path, seeds):
    with pytest.raises(ConfigError, match="seeds must differ and be at least 0"):
        check(dataclasses.replace(_command(tmp_path), seeds=seeds))


def test_a_slow_robot_takes_more_steps_for_each_metre_and_its_policy_drives_as_slowly():
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="control")
    drive = scores.record(env, params, jax.random.key(0), 2, last=32, speed=0.5)
    steps = np.diff(np.asarray(drive.record.driven), axis=1)
    assert steps.shape[1] == scores.steps_of(params, 0.5, 32) - 1 == 4 * scores.steps_of(params, None, 32) - 1
    assert steps.max() == pytest.approx(0.05, abs=1e-3)
    assert np.median(steps) > 0.045
    layout = {"network": "kalman", "action_low": [0.0, -1.5], "action_high": [2.0, 1.5]}
    weights = flat(memory.init("kalman", "match", jax.random.key(0)))
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="control", estimates=True)
    for speed, expected in ((None, 2.0), (0.5, 0.5)):
        told = layout if speed is None else {**layout, "speed": speed}
        agent = policies.from_tensors("locate", told, weights, "one")
        assert agent.speed == speed
        assert _fastest(agent, env, params) == pytest.approx(expected, abs=1e-3)


def _fastest(agent, env, params):
    """Returns the largest speed that an agent commands in its first 20 steps, m/s."""
    key = jax.random.key(1)
    state = env.begin(env.draw_reset(key, (), params), params)

    def step(carry, t):
        state, mind = carry
        noise = env.draw_step(jax.random.fold_in(key, t), (), params)
        seen = observed(env, params, env.observe(state, noise, params))
        action, mind = agent.act(key, mind, seen, params, None)
        return (env.advance(state, action[: env.action_size], noise, params)[0], mind), action[0]

    first = observed(env, params, env.observe(state, env.draw_step(key, (), params), params))
    mind = agent.begin(key, first, params)
    return float(jax.jit(lambda carry: jax.lax.scan(step, carry, jnp.arange(20)))((state, mind))[1].max())


def test_scores_are_told_by_kind():
    names = ["open:cast:val:0", "open:rock:val:0"]
    found = {"within": np.array([1.0, 0.5, 0.0, np.nan]), "error": np.array([0.1, 0.3, 9.0, np.nan])}
    table = scores.by_kind(found, np.array([0, 0, 1, 1]), names)
    assert table["cast"] == {"within": 0.75, "error": pytest.approx(0.2)}
    assert table["rock"] == {"within": 0.0, "error": 9.0}
    assert table["all"]["within"] == 0.5


def _made_up_drive(n_envs, share):
    """Robots that drive (1 + share) times what is commanded, as their odometers say, past smooth walls."""
    driven = jnp.broadcast_to(0.2 * jnp.arange(200.0), (n_envs, 200))
    points = Points(jnp.zeros((n_envs, 200, 2, 7)), jnp.zeros((n_envs, 200, 2, 7)), jnp.ones((n_envs, 200, 2, 7), bool))
    scale = 1.0 + jnp.asarray(share)[:, None]
    start = jnp.full(n_envs, 70.0)
    return Drive(Record(driven, scale * driven, points), scale * driven, start, jnp.zeros(n_envs, jnp.int32))


def test_a_judge_counts_the_goals_at_which_the_estimate_is_right():
    drives = _made_up_drive(3, [0.0, 0.02, 0.5])
    weights = memory.init("kalman", "match", jax.random.key(0))
    found = scores.make_judge("kalman", 38)(weights, drives)
    assert found["within"][0] == 1.0
    assert found["within"][2] < 0.2
    assert found["found"][0] < found["found"][1] < found["found"][2]


@pytest.mark.parametrize(("network", "with_map"), [("gru", True), ("transformer-kalman", False)])
def test_a_state_before_training_has_the_types_of_one_after_an_iteration(network, with_map):
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="subterra-351")
    learner = LocateLearner(env, params, dataclasses.replace(_SMALL, network=network, map=with_map))
    before = jax.eval_shape(learner.init, 0)
    strip = map_strip(params.tunnel) if with_map else None
    after, _ = jax.eval_shape(learner.iterate, before, params, jnp.float32(1.0), strip)
    for one, other in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        assert (one.shape, one.dtype, one.weak_type) == (other.shape, other.dtype, other.weak_type)


@pytest.mark.parametrize(("sensor", "sides"), [("planar16", 2), ("spin16x64", 12)])
def test_a_training_begins_with_the_weights_that_it_is_told_to_begin_from(sensor, sides):
    tunnel = tunnels.load(["control"], sensor=sensor)[0]
    env, params = st.make("Subterra/StopAtShort-v1", tunnel=tunnel, sensor=sensor)
    config = dataclasses.replace(_SMALL, network="transformer", begin_from="locate-transformer")
    weights = flat(jax.vmap(LocateLearner(env, params, config).init)(jnp.arange(2)).weights)
    given = policies.load("locate-transformer")[0].tensors
    assert set(weights) == set(given)
    for name, tensor in given.items():
        less = np.log(sides / 2) if name == "match.count" else 0.0  # the evidence of all sides is summed
        np.testing.assert_allclose(weights[name], np.broadcast_to(tensor - less, weights[name].shape), rtol=1e-6)


def _patches(station):
    edges = np.cumsum(np.random.default_rng(3).uniform(0.3, 1.5, 400))
    return np.where(np.searchsorted(edges, station) % 2 == 0, 0.03, 0.0)


def _drives_past_relief(n_envs, n_steps=160):
    """Robots that drive exactly what is commanded, past relief of 3 cm under noise of 5 cm; and the map of it."""
    driven = np.broadcast_to(0.2 * np.arange(float(n_steps)), (n_envs, n_steps))
    along = np.broadcast_to(2.7 / np.tan(np.deg2rad(22.5) * np.arange(1, 8)), (n_envs, n_steps, 2, 7))
    rng = np.random.default_rng(0)
    start = rng.uniform(60.0, 120.0, n_envs)
    out = _patches(start[:, None, None, None] + driven[..., None, None] + along) + 0.05 * rng.standard_normal(
        along.shape
    )
    points = Points(jnp.asarray(along, jnp.float32), jnp.asarray(out, jnp.float32), jnp.ones(along.shape, bool))
    real = jnp.asarray(driven, jnp.float32)
    drive = Drive(Record(real, real, points), real, jnp.asarray(start, jnp.float32), jnp.zeros(n_envs, jnp.int32))
    wall = 2.7 + np.broadcast_to(_patches(0.1 * (np.arange(2400) + 0.5)), (2, 2400))
    zero, many = jnp.zeros(1, jnp.int32), jnp.full(1, 2400, jnp.int32)
    return drive, MapStrip(jnp.asarray(wall, jnp.float32), zero, many, zero)


@pytest.mark.slow
def test_what_is_learnt_with_a_map_finds_hidden_starts_and_leaves_wrong_maps_aside():
    drive, strip = _drives_past_relief(12)
    params = SimpleNamespace(tunnel=SimpleNamespace(count=1, length=jnp.float32(240.0)))
    config = dataclasses.replace(_SMALL, hidden=0.7, wrong=0.4)
    answers = Estimate(jnp.zeros((12, 30)), jnp.zeros((12, 30)), jnp.full((12, 30), -2.0))
    truth, valid = jnp.zeros((12, 30)), jnp.ones((12, 30), bool)

    def loss(own, told):
        taught, terms = jax.vmap(lambda *one: map_loss({"map": own}, *one, strip))(drive, told, answers, truth, valid)
        return jnp.mean(taught), terms

    weights = map_filter.init(jax.random.key(1))
    weights["log_odds"] = weights["log_odds"] + 4.0  # it begins by believing every map
    optimizer = optax.adam(0.03)
    step = jax.jit(jax.value_and_grad(loss, has_aux=True))
    moments, losses = optimizer.init(weights), []
    for index in range(25):
        told = draw_told(jax.random.key(index % 3), drive, params, config)
        (value, _), gradients = step(weights, told)
        changes, moments = optimizer.update(gradients, moments)
        weights = optax.apply_updates(weights, changes)
        losses.append(float(value))
    assert np.mean(losses[-3:]) < 0.8 * np.mean(losses[:3])
    told = draw_told(jax.random.key(99), drive, params, config)
    assert 0 < int(told.right.sum()) < 12
    _, terms = loss(weights, told)
    of = lambda name, rows: float(jnp.sum(terms[name] * rows) / jnp.sum(rows)) / 18.0  # noqa: E731
    assert of("mapped", told.right) > 0.7
    assert of("misled", ~told.right) < 0.3


def test_what_is_told_is_off_as_a_hidden_start_is_and_a_wrong_map_is_of_another_place():
    drive = _made_up_drive(4000, np.zeros(4000))
    params = SimpleNamespace(tunnel=SimpleNamespace(count=3, length=jnp.array([500.0, 600.0, 700.0])))
    told = draw_told(jax.random.key(0), drive, params, dataclasses.replace(_SMALL, hidden=0.5, wrong=0.2))
    hidden, right = np.asarray(told.sigma) > 0.0, np.asarray(told.right)
    assert np.mean(hidden) == pytest.approx(0.5, abs=0.03)
    assert np.mean(right) == pytest.approx(0.8, abs=0.03)
    assert np.all(np.asarray(told.offset)[~hidden] == 0.0)
    assert np.std(np.asarray(told.offset)[hidden]) == pytest.approx(3.0, abs=0.15)
    assert np.all(np.asarray(told.tunnel)[right] == 0)
    assert np.all(np.asarray(told.shift)[right] == 0.0)
    assert set(np.asarray(told.tunnel)[~right]) == {1, 2}
    one = SimpleNamespace(tunnel=SimpleNamespace(count=1, length=jnp.float32(500.0)))
    alone = draw_told(jax.random.key(0), drive, one, dataclasses.replace(_SMALL, wrong=0.5))
    away = np.abs(np.asarray(alone.shift))[~np.asarray(alone.right)]
    assert away.min() > 49.0, "of one tunnel a wrong map is another part of it"


@pytest.mark.slow
def test_gradients_do_not_depend_on_the_chunks():
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="subterra-351")
    drives = _made_up_drive(4, [0.0, 0.01, -0.02, 0.03])
    found = []
    for chunk in (4, 1):
        learner = LocateLearner(env, params, dataclasses.replace(_SMALL, n_envs=4, minibatch=4, chunk=chunk))
        found.append(jax.jit(learner._gradients)(learner.init(0).weights, (drives, None), None))
    for one, other in zip(jax.tree.leaves(found[0]), jax.tree.leaves(found[1]), strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-3, atol=1e-5)


def test_a_folder_that_holds_a_run_is_neither_written_over_nor_gone_on_with_as_another(tmp_path):
    command = _command(tmp_path)
    keeping.write_config(command)  # a run that was killed before its first checkpoint
    begun = (tmp_path / "config.json").read_bytes()
    with pytest.raises(RunFolderError, match="holds a run already; --resume goes on with it, --overwrite replaces it"):
        session.run(command)
    other = dataclasses.replace(_command(tmp_path, n_steps=220), resume=True)
    with pytest.raises(ConfigError, match="was begun with another n_steps"):
        session.run(other)
    with pytest.raises(ConfigError, match="was begun with another seeds"):
        session.run(dataclasses.replace(command, seeds=(5,), resume=True))
    assert (tmp_path / "config.json").read_bytes() == begun
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(ConfigError, match="cannot be read; --overwrite begins anew"):
        session.run(dataclasses.replace(command, resume=True))


@pytest.mark.slow
def test_a_run_writes_policies_that_load_and_goes_on_as_what_it_was(tmp_path, monkeypatch):
    settings = {"tunnels": "control", "val": "control", "task": "Subterra/StopAtShort-v1", "drives": 2, "seeds": (3, 4)}
    command = dataclasses.replace(_command(tmp_path, minutes=0.01, speed=1.5), **settings)
    session.run(command)
    folder = tmp_path / "seed-3"
    assert policies.load(folder / "policy.safetensors")[0].speed == 1.5
    first = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    assert len(first) == 1
    assert json.loads((folder / "scores.json").read_text())["seed"] == 3
    begun = (tmp_path / "config.json").read_bytes()
    with pytest.raises(ConfigError, match="was begun with another n_steps"):
        session.run(dataclasses.replace(command, resume=True, config=dataclasses.replace(command.config, n_steps=220)))
    assert (tmp_path / "config.json").read_bytes() == begun
    with (folder / "log.jsonl").open("a") as log:
        log.write('{"step": 80')  # a line that a kill cut off
    longer = dataclasses.replace(command.config, minutes=(first[0]["seconds"] + 30.0) / 60.0)
    session.run(dataclasses.replace(command, resume=True, config=longer))
    second = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    assert second[0] == first[0]
    assert [row["step"] for row in second] == [400 * (i + 1) for i in range(len(second))]
    assert len(second) > 1
    steps = iterations(tmp_path)[-1]
    with pytest.raises(RunFolderError, match="holds a run already"):
        session.run(command)
    session.run(dataclasses.replace(command, overwrite=True))
    assert len((folder / "log.jsonl").read_text().splitlines()) == 1
    assert iterations(tmp_path) == [1] != [steps], "a checkpoint of the run that was thrown away is still there"


def _table(path, digest, agents):
    cell = {
        "success": 0.5,
        "low": 0.4,
        "high": 0.6,
        "contact": 0.0,
        "median_error": 0.3,
        "by_tunnel": [],
        "episodes": [],
    }
    content = {
        "schema": "subterra.kinds/1",
        "config": {"task": "Subterra/StopAt-v1", "split": "val", "episodes": 10},
        "rows": {agent: {"cast": {**cell, "success": 0.1 * i}} for i, agent in enumerate(agents)},
        "policies": {agent: digest for agent in agents if "fused" not in agent},
    }
    path.write_text(json.dumps(content))
    return path


def test_a_card_takes_the_rows_of_its_own_policy(tmp_path):
    table = _table(tmp_path / "kinds.json", "abc", ("fused", "p.safetensors", "cut:p.safetensors"))
    row = release._rows(table, "abc")
    assert (row["task"], row["as it is"]["cast"]["success"], row["cut"]["cast"]["success"]) == (
        "Subterra/StopAt-v1",
        0.1,
        0.2,
    )
    with pytest.raises(ConfigError, match="has no row of this policy"):
        release._rows(table, "other")
    (tmp_path / "junk.json").write_text('{"schema": "x"}')
    with pytest.raises(ConfigError, match=r"is no table of benchmarks"):
        release._rows(tmp_path / "junk.json", "abc")


@pytest.mark.slow
def test_a_released_localiser_is_loaded_with_its_card(tmp_path):
    task, out = "Subterra/StopAtShort-v1", tmp_path / "locate-mine.safetensors"
    command = Command(out=tmp_path, task=task, tunnels="control", val="control", drives=2, config=_SMALL)
    session.run(dataclasses.replace(command, config=dataclasses.replace(_SMALL, minutes=0.01)))
    policy = tmp_path / "seed-0" / "policy.safetensors"
    digest = json.loads(policy.with_suffix(".json").read_text())["tensors_sha256"]
    table = _table(tmp_path / "kinds.json", digest, ("p", "cut:p"))
    release.release(tmp_path / "seed-0", out, 2, (table,))
    agent, card = policies.load(out)
    assert agent.name == "locate-mine"
    assert card["trained_under"]["n_beams"] == 16
    assert card["measured"][0]["cut"]["cast"]["success"] == pytest.approx(0.1)
    assert card["success_against_time"]
    assert out.read_bytes() == policy.read_bytes()


@pytest.mark.slow
def test_a_filter_learns_what_lasts_over_a_drive_where_walls_tell_nothing(monkeypatch):
    monkeypatch.setattr(scores, "FARTHEST", 38)
    monkeypatch.setattr(scores, "FIRST", 10)
    weights = memory.init("transformer", "match", jax.random.key(0))
    drives = _made_up_drive(6, [0.0, 0.01, -0.02, 0.03, -0.03, 0.02])
    rows = filtering.look("transformer", weights, drives)
    np.testing.assert_allclose(rows.truth[:, -1], 38.0 * np.array([0.0, 0.01, -0.02, 0.03, -0.03, 0.02]), atol=0.01)
    before = filtering.judged(filtering.plain_answers("transformer", weights, rows), rows)
    command = filtering.Command(policy=Path("x"), out=Path("y"), updates=60, minibatch=6)
    own, log = filtering.learn("transformer", weights, rows, command)
    after = filtering.judged(filtering.answers_of(own, rows), rows)
    assert log[-1]["loss"] < log[0]["loss"] - 1.0
    assert after["found"].max() < 0.1 < before["found"].max()
    np.testing.assert_allclose(after["within"], 1.0)


def test_a_look_weighs_kinds_alike_and_leaves_out_drives_without_a_goal():
    share = np.array([1.0, 0.5, 0.0, 0.0, 0.2, np.nan])
    found = look.table(share, np.array([0, 0, 1, 1, 2, 2]), np.array(["cast"] * 4 + ["rock"] * 2))
    assert found["cast"]["success"] == pytest.approx(0.375)
    assert (found["rock"]["success"], found["rock"]["n"]) == (pytest.approx(0.2), 1)
    assert found["all"]["success"] == pytest.approx((0.375 + 0.2) / 2)
    assert found["cast"]["low"] < 0.1 < 0.7 < found["cast"]["high"], "two tunnels that differ leave a wide interval"


def test_the_figure_takes_localisers_and_whole_drivers(tmp_path):
    seed = tmp_path / "locate" / "seed-0"
    seed.mkdir(parents=True)
    rows = [{"seconds": 10.0 * i, "within": 0.2 * i} for i in range(3)]
    (seed / "curve.jsonl").write_text("\n".join(map(json.dumps, rows)))
    (tmp_path / "locate" / "config.json").write_text('{"config": {"network": "s5", "front": "match"}}')
    driver = tmp_path / "driver"
    driver.mkdir()
    lines = [{"episodes": 60 * i, "success_mean_100": 0.1 * i, "timing": {"seconds": 5.0 * i}} for i in range(4)]
    (driver / "log.jsonl").write_text("\n".join(map(json.dumps, lines)))
    (driver / "config.json").write_text('{"config": {"teacher": "oracle"}}')
    (label,) = figure.read_run(tmp_path / "locate")
    assert label == "s5, match (1 seed)"
    ((label, (curve,)),) = figure.read_run(driver).items()
    assert "taught by oracle" in label
    np.testing.assert_allclose(curve, [(10.0, 0.2), (15.0, 0.3)])
    figure.command(figure.Command((tmp_path / "locate", driver), tmp_path / "curve.png"))
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    (driver / "log.jsonl").write_text(json.dumps(lines[1]))
    with pytest.raises(ConfigError, match="holds no hundred episodes"):
        figure.read_run(driver)
