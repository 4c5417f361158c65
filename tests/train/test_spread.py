"""Training spread over devices and processes comes to what one device does."""

import os
import subprocess
import sys

from tests.train.conftest import TASK, call
from train import __main__ as navigate

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


def test_parts_that_do_not_divide_the_environments_and_seeds_with_parts_are_refused(tmp_path, capsys):
    out = ("--task", TASK, "--out", str(tmp_path / "run"), "--preset=cpu")
    assert call(navigate.main, *out, "--parts=3") == 2
    assert "n_envs = 128 cannot be divided into parts = 3 of minibatches = 4" in capsys.readouterr().err
    assert call(navigate.main, *out, "--parts=2", "--seeds", "0", "1") == 2
    assert "parts = 2 cannot be trained for several seeds at once" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
