"""Checkpoints and logs of a run: kept, damaged, changed, resumed from; files, figure and table of seeds."""

import csv
import dataclasses
import functools
import json
import shutil
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from tests.recorded import check
from tests.train.conftest import weights_of
from train import checkpoint, curve, folder, session, sinks, snapshot
from train.checkpoint import CheckpointError
from train.config import ConfigError, TrainConfig
from train.driver import Driver, Policy
from train.log import RunLog
from train.report import Ended
from train.setup import make_layout, make_learner
from train.snapshot import COLUMNS, Best, EpisodeWindow, Snapshot
from train.world import open_world

TASK = "Subterra/TraverseShort-v1"
FACTS = {"task": TASK}


@functools.cache
def policy_of(seed, hidden=16):
    env, params = st.make(TASK)
    driver = Driver(env, make_layout(env, params, TrainConfig(hidden=(hidden,))))
    return Policy(weights_of(driver, seed))


def like(hidden=16):
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), policy_of(0, hidden))


@pytest.fixture
def saved(tmp_path):
    checkpoint.save_checkpoint(tmp_path / "run", 7, {"policy": policy_of(0)}, FACTS)
    return tmp_path / "run"


def test_a_policy_is_read_back_to_the_bit(saved):
    stored = checkpoint.load_checkpoint(saved)
    jax.tree.map(np.testing.assert_array_equal, stored.restore("policy", like()), policy_of(0))
    assert stored.facts["task"] == TASK


def test_a_checkpoint_can_be_named_by_its_run_its_folder_or_itself(saved):
    for place in (saved, saved / "checkpoint", saved / "checkpoint" / "00000007"):
        assert checkpoint.load_checkpoint(place).path.name == "00000007"


def test_the_last_two_checkpoints_are_kept_and_the_newest_is_read(saved):
    for iteration in (8, 20, 100):
        checkpoint.save_checkpoint(saved, iteration, {"policy": policy_of(iteration)}, FACTS)
    assert sorted(path.name for path in (saved / "checkpoint").iterdir()) == ["00000020", "00000100"]
    assert checkpoint.load_checkpoint(saved).path.name == "00000100"


def test_what_a_kill_leaves_behind_is_never_read(saved):
    shutil.copytree(saved / "checkpoint" / "00000007", saved / "checkpoint" / ".00000009.partial")
    assert checkpoint.load_checkpoint(saved).path.name == "00000007"
    checkpoint.save_checkpoint(saved, 9, {"policy": policy_of(1)}, FACTS)
    assert checkpoint.load_checkpoint(saved).path.name == "00000009"


@pytest.mark.usefixtures("collected")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # a thread of the storage library's
def test_a_truncated_checkpoint_is_a_clear_error_whichever_file_it_is(saved, tmp_path):
    place = saved / "checkpoint" / "00000007"
    files = [path for path in place.rglob("*") if path.is_file() and path.stat().st_size > 0]
    assert len(files) > 2
    refused = 0
    for path in files:
        copy = tmp_path / "copy"
        shutil.copytree(place, copy)
        victim = copy / path.relative_to(place)
        victim.write_bytes(victim.read_bytes()[: victim.stat().st_size // 2])
        try:
            restored, message = checkpoint.load_checkpoint(copy).restore("policy", like()), None
        except CheckpointError as error:
            restored, message = None, str(error)
        if message is None:  # a file that holds nothing needed
            jax.tree.map(np.testing.assert_array_equal, restored, policy_of(0))
        else:
            assert str(copy) in message
            assert "damaged checkpoint" in message
            refused += 1
        shutil.rmtree(copy)
    assert refused >= 2


def test_an_array_that_was_changed_is_refused(saved, tmp_path):
    other = tmp_path / "other"
    checkpoint.save_checkpoint(other, 7, {"policy": policy_of(1)}, FACTS)
    arrays = saved / "checkpoint" / "00000007" / "arrays"
    shutil.rmtree(arrays)
    shutil.copytree(other / "checkpoint" / "00000007" / "arrays", arrays)
    with pytest.raises(CheckpointError, match="not those that were written"):
        checkpoint.load_checkpoint(saved)


def test_what_cannot_be_restored_is_refused_with_its_cause(saved, tmp_path):
    with pytest.raises(CheckpointError, match="no such folder"):
        checkpoint.load_checkpoint(tmp_path / "nowhere")
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        checkpoint.load_checkpoint(tmp_path)
    with pytest.raises(CheckpointError, match=r"another network: .*\[16\].*\[24\]"):
        checkpoint.load_checkpoint(saved).restore("policy", like(24))
    (saved / "checkpoint" / "00000007" / checkpoint.FACTS).write_text('{"schema": "subterra.tunnel/1"}')
    with pytest.raises(CheckpointError, match="'schema'"):
        checkpoint.load_checkpoint(saved)


def test_a_resumed_run_knows_its_best_score_and_for_how_long_the_goal_has_held(tunnel, tmp_path):
    world = open_world(TASK, tunnel)
    learner = make_learner(world, TrainConfig(n_envs=4, unroll=8, minibatches=2, hidden=(8,)))
    run = folder.RunFolder(tmp_path / "run", world, learner)
    run.start()
    state = jax.eval_shape(learner.init, jax.random.PRNGKey(0), world.params)
    first = snapshot.started(learner, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), state))
    best = dataclasses.replace(first.best, score=(0.75, 12.5), iteration=4)
    run.save(dataclasses.replace(first, iteration=9, solved_for=3, best=best))
    again = run.resume()
    assert (again.iteration, again.solved_for) == (9, 3)
    assert (again.best.score, again.best.iteration) == ((0.75, 12.5), 4)


@pytest.mark.parametrize(("succeeded", "held"), [(1.0, 1), (0.99, 0), (0.6, 0)])
def test_the_goal_holds_where_every_one_of_a_hundred_episodes_succeeded(succeeded, held):
    n = 100
    good = np.arange(n) < n * succeeded
    ended = Ended(n, np.arange(n), np.full(n, 0.95, np.float32), good, ~good, np.ones(n), np.full(n, 9))
    config = TrainConfig(stop_coverage=0.9, n_envs=4, unroll=8)
    before = Snapshot(0, None, EpisodeWindow(), Best.of(None, EpisodeWindow(), 0, None))
    assert snapshot.advance(before, None, None, ended, {}, config).solved_for == held


def test_a_reward_that_is_no_number_ends_the_training_in_one_sentence():
    ended = Ended(0, *(np.zeros(0) for _ in range(6)))
    before = Snapshot(0, None, EpisodeWindow(), Best.of(None, EpisodeWindow(), 0, None))
    for name, error in (("reward_mean", snapshot.RewardError), ("policy_loss", snapshot.TrainingError)):
        with pytest.raises(error, match=r"^iteration 1: .*finite"):
            snapshot.advance(before, None, None, ended, {name: np.float32("nan")}, TrainConfig())


def record(iteration, success):
    timing = {"seconds": 1.5 * iteration, "compile_seconds": 0.5, "steps_per_second": 1_234_567_890_123}
    values = {"iteration": iteration, "step": 100 * iteration, "episodes": 2 * iteration, "success_mean_100": success}
    return {**values, "policy_loss": -0.125 * iteration, "timing": timing}


def write(run, iterations, **options):
    log = RunLog(run, **options)
    for iteration in iterations:
        rows = np.zeros(2, COLUMNS)
        rows["episode"], rows["coverage"] = (2 * iteration - 1, 2 * iteration), 0.1 * iteration
        log.write(record(iteration, None if iteration == 1 else 0.5), rows)
    log.close()


def test_the_table_says_what_the_log_says_with_a_column_each_and_gaps_where_nothing_is_known(tmp_path):
    write(tmp_path, (1, 2, 3))
    with (tmp_path / "log.csv").open() as file:
        table = list(csv.DictReader(file))
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert len(table) == len(lines) == 3
    for row, line in zip(table, lines, strict=True):
        flat = {**line, **line.pop("timing")}
        for name, cell in row.items():
            assert cell == "" if flat[name] is None else float(cell) == pytest.approx(flat[name], rel=1e-8), name
    assert table[0]["success_mean_100"] == ""
    assert table[2]["steps_per_second"] == "1234567890123"


def test_iterations_after_the_last_checkpoint_are_forgotten_in_every_file(tmp_path):
    write(tmp_path, (1, 2, 3))
    whole = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    write(tmp_path, (2, 3), iteration=1, episodes=2)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == whole
    assert set(whole) == {"log.csv", "log.jsonl", "episodes.csv"}


def test_tensorboard_gets_every_number_at_its_step(tmp_path):
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    written = sinks.Board(tmp_path)
    for iteration in (1, 2):
        written.write(record(iteration, None if iteration == 1 else 0.5))
    written.close()
    (path,) = (tmp_path / "tensorboard").iterdir()
    found = {}
    for event in events(path.read_bytes(), event_pb2.Event):
        found |= {(value.tag, event.step): value.simple_value for value in event.summary.value}
    assert found[("loss/policy_loss", 100)] == -0.125
    assert found[("loss/policy_loss", 200)] == -0.25
    assert found[("episodes/success_mean_100", 200)] == 0.5
    assert ("episodes/success_mean_100", 100) not in found


def events(content, event_type):
    """Length (8 bytes), its checksum (4), the event, its checksum (4); and again."""
    while content:
        size = int.from_bytes(content[:8], "little")
        yield event_type.FromString(content[12 : 12 + size])
        content = content[16 + size :]


def test_tensorboard_without_its_library_is_a_clear_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(ConfigError, match=r"needs tensorboardX: pip install 'subterra-jax\[logs\]'"):
        sinks.tensorboard_writer()


def runs(folder, coverages, task="Subterra/Traverse-v1"):
    for k, coverage in enumerate(coverages):
        run = folder / f"seed-{k}"
        run.mkdir()
        (run / "config.json").write_text(json.dumps({"task": task}))
        log = [{"step": step, "timing": {"seconds": 10.0 + step / 1000}} for step in (100, 20_000)]
        (run / "log.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in log))
        rows = [f"{i + 1},{100 * (i + 1)},{c},{c > 0.5:d},7,0" for i, c in enumerate(coverage)]
        (run / "episodes.csv").write_text("\n".join(["episode,step,coverage,success,length,contact", *rows, ""]))
    return sorted(folder.iterdir())


def test_the_figure_of_a_task_with_a_goal_is_success_against_steps_and_seconds_with_lines(tmp_path, monkeypatch):
    from matplotlib import pyplot

    shown = []
    monkeypatch.setattr(pyplot, "close", shown.append)
    curve.write_curve(runs(tmp_path, [[0.9] * 150], "Subterra/StopAt-v1"), tmp_path / "c.png", {"floor": 0.32})
    steps, seconds = shown[0].axes
    assert ["steps" in steps.get_xlabel(), "seconds" in seconds.get_xlabel()] == [True, True]
    for axes, last in ((steps, 0.015), (seconds, 10.0 + 15.0)):
        lines = {line.get_label(): line for line in axes.get_lines()}
        assert lines["floor, 32 %"].get_ydata() == pytest.approx([32.0, 32.0])
        assert lines["seed-0"].get_xdata()[-1] == pytest.approx(last)
        assert lines["seed-0"].get_ydata()[-1] == 100.0


def test_a_run_without_finished_episodes_is_drawn_empty(tmp_path):
    (run,) = runs(tmp_path, [[]])
    curve.write_curve([run], tmp_path / "curve.png")
    assert (run / "curve.csv").read_text() == "episode,step,coverage_mean_100,success_mean_100\n"


def test_the_table_of_seeds_has_a_line_each_and_their_mean_and_spread(tmp_path, capsys):
    (tmp_path / "out").mkdir()
    found = []
    for k, steps in enumerate((1000, 3000)):
        run = tmp_path / "out" / f"seed-{k}"
        run.mkdir()
        timing = {"seconds": 0.01 * steps, "compile_seconds": 5.0}
        line = {"episodes": 120, "coverage_mean_100": 0.95, "success_mean_100": 1.0, "step": steps, "timing": timing}
        (run / "log.jsonl").write_text(json.dumps(line) + "\n")
        found.append(run)
    session.write_summary(tmp_path / "out", found, [{"success": 1.0}, {"success": 0.5}], covers=True)
    outcome = json.loads((tmp_path / "out" / "seeds.json").read_text())["mean_sd"]
    assert outcome["steps"] == pytest.approx([2000.0, 1000.0 * np.sqrt(2.0)])
    assert outcome["seconds_compiled"] == pytest.approx([15.0, 10.0 * np.sqrt(2.0)])
    assert outcome["episodes"] == [120.0, 0.0]
    check(__file__, "seeds", {"text": (tmp_path / "out" / "seeds.json").read_text().replace(str(tmp_path), "")})
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    cells = {line.split()[1]: line.replace("│", " ").split()[1:] for line in lines if line.startswith("│")}
    assert cells["seed-1"] == ["120.0", "3.0", "30.0", "25.0", "95.00", "50.0"]
    assert cells["mean"] == ["120.0", "2.0", "20.0", "15.0"]
    assert [line for line in lines if "± sd" in line]
    session.write_summary(tmp_path / "out", found, [{"success": 1.0}, {"success": 0.5}], covers=False)
    assert "75.0 ± 35.4" in capsys.readouterr().out
