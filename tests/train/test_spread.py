import os
import socket
import subprocess
import sys

import numpy as np
import pytest

from tests.train.conftest import TASK, call, log_without_timing
from train import __main__ as navigate
from train import devices
from train.config import ConfigError
from train.devices import Cluster

SMALL = ("--n-envs=16", "--unroll=32", "--minibatches=2", "--epochs=1", "--hidden", "8", "--parts=2", "--steps=1536")
MORE = ("--stop-coverage=2", "--checkpoint-every=1", "--evaluation-episodes=2", "--preset=cpu")


def processes(n_devices: int, *lines: tuple[str, ...]) -> None:
    """Runs commands of `train` at the same time, each with so many CPU devices."""
    flags = f"--xla_force_host_platform_device_count={n_devices} " + os.environ.get("XLA_FLAGS", "")
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    started = [
        subprocess.Popen([sys.executable, "-m", "train", *line], env=environment, stderr=subprocess.PIPE)
        for line in lines
    ]
    try:
        for process in started:
            _, error = process.communicate(timeout=200)
            assert process.returncode == 0, error.decode()
    finally:
        for process in started:
            process.kill()


def assert_alike(one, other):
    lines = list(zip(log_without_timing(one), log_without_timing(other), strict=True))
    assert len(lines) == 3
    for a, b in lines:
        for name, value in a.items():
            assert value == pytest.approx(b[name], rel=1e-3, abs=1e-4), name
    rows = [np.genfromtxt(run / "episodes.csv", delimiter=",", names=True) for run in (one, other)]
    assert len(rows[0]) > 10
    np.testing.assert_array_equal(rows[0]["step"], rows[1]["step"])
    np.testing.assert_allclose(rows[0]["coverage"], rows[1]["coverage"], rtol=1e-3)


@pytest.fixture(scope="module")
def line(tunnel):
    return ("--task", TASK, "--tunnel", str(tunnel), *SMALL, *MORE)


@pytest.fixture(scope="module")
def one_device(line, tmp_path_factory):
    out = tmp_path_factory.mktemp("spread") / "one"
    assert call(navigate.main, *line, "--out", str(out)) == 0
    return out


TWO_DEVICES = """
import dataclasses, sys
import jax, numpy as np
from train.config import TrainConfig
from train.devices import Spread
from train.setup import make_learner
from train.world import open_world

one, two = jax.devices()
world = open_world(sys.argv[1], sys.argv[2])
config = TrainConfig(n_envs=8, unroll=16, minibatches=2, epochs=1, hidden=(8,), parts=2, steps=256)
inner = make_learner(world, config).learner
runs = {}
for devices in ((one,), (one, two)):
    learner = Spread(inner, list(devices))
    assert learner.mesh.size == len(devices)
    params = learner.share(world.params)
    state = jax.jit(learner.init)(learner.share(jax.random.PRNGKey(0)), params)
    iterate = jax.jit(learner.iterate)
    for _ in range(2):
        middle, state = state, iterate(state, params)[0]
    runs[len(devices)] = learner, params, iterate, learner.gather(middle), learner.gather(state)
alike = lambda a, b: jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5), a, b)
alike(runs[1][-1], runs[2][-1])
learner, params, iterate, *_ = runs[2]  # what one device left, two go on with
alike(learner.gather(iterate(learner.place(runs[1][-2]), params)[0]), runs[1][-1])
moved = jax.tree.map(lambda x, y: np.abs(x - y).max(), runs[1][-2].student.weights, runs[1][-1].student.weights)
assert max(jax.tree.leaves(moved)) > 1e-6
"""


def test_two_devices_come_to_what_one_does_and_go_on_from_its_state(tunnel):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    words = [sys.executable, "-c", TWO_DEVICES, TASK, str(tunnel)]
    ran = subprocess.run(words, env=environment, capture_output=True, text=True, check=False, timeout=200)
    assert ran.returncode == 0, ran.stderr


@pytest.mark.slow
def test_two_processes_come_to_what_one_does(line, one_device, tmp_path):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    both = ("--coordinator", f"localhost:{port}", "--processes=2", "--out", str(tmp_path / "both"))
    processes(1, (*line, *both, "--process=0"), (*line, *both, "--process=1"))
    assert_alike(one_device, tmp_path / "both")
    assert (tmp_path / "both" / "evaluation.json").exists()


def test_parts_that_do_not_divide_the_environments_and_seeds_with_parts_are_refused(tmp_path, capsys):
    out = ("--task", TASK, "--out", str(tmp_path / "run"), "--preset=cpu")
    assert call(navigate.main, *out, "--parts=3") == 2
    assert "n_envs = 128 cannot be divided into parts = 3 of minibatches = 4" in capsys.readouterr().err
    assert call(navigate.main, *out, "--parts=2", "--seeds", "0", "1") == 2
    assert "parts = 2 cannot be trained for several seeds at once" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_launcher_is_found_by_the_processes_it_says_it_started():
    assert devices.find_launcher({}) is None
    assert devices.find_launcher({"SLURM_JOB_ID": "7", "SLURM_STEP_NUM_TASKS": "1"}) is None
    assert devices.find_launcher({"SLURM_STEP_NUM_TASKS": "2"}) == "Slurm"
    assert devices.find_launcher({"OMPI_COMM_WORLD_SIZE": "4"}) == "Open MPI"


def test_processes_by_hand_must_be_told_whole_and_in_range():
    assert devices.resolve_cluster(Cluster("a:1", 2), {"JOB_COMPLETION_INDEX": "1"}) == Cluster("a:1", 2, 1)
    assert devices.resolve_cluster(Cluster(), {"JOB_COMPLETION_INDEX": "1"}) == Cluster()
    for wrong in (Cluster("a:1"), Cluster(processes=2, process=0), Cluster("a:1", 2)):
        with pytest.raises(ConfigError, match="given together"):
            devices.resolve_cluster(wrong, {})
    with pytest.raises(ConfigError, match="got 2"):
        devices.resolve_cluster(Cluster("a:1", 2, 2), {})
