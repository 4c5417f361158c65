import gc
import json
import os
import sys
from functools import partial
from pathlib import Path

import jax
import pytest
from filelock import FileLock
from jaxtyping import install_import_hook

from tests.subterra_jax import checking
from tests.subterra_jax.tunnels import write_corridor

# Shapes in annotations are checked at run time, so that they cannot go stale. Not those of pytrees: jax also rebuilds
# them around NumPy arrays, shapes and booleans.
CHECKED = ("train.learning", "train.rollout")
with install_import_hook(CHECKED, f"{checking.__name__}.check_functions"):
    from train import __main__ as navigate

TASK = "Subterra/TraverseShort-v1"
SMALL = ("--n-envs=64", "--unroll=64", "--minibatches=4", "--hidden", "32", "32")


def call(main, *arguments: str) -> int:
    """Exit status of a command, run in this process."""
    before = sys.argv
    sys.argv = ["command", *arguments]
    try:
        with pytest.raises(SystemExit) as caught:
            main()
    finally:
        sys.argv = before
    return caught.value.code


@partial(jax.jit, static_argnums=(0, 1, 2))
def weights_of(driver, seed: int, more: float = 0.0):
    """Fresh weights of a network, and something added to each, by one program."""
    return jax.tree.map(lambda leaf: leaf + more, driver.init(jax.random.PRNGKey(seed)))


@pytest.fixture(scope="session")
def tunnel(tmp_path_factory) -> Path:
    """A straight tunnel of 20 m."""
    return write_corridor(tmp_path_factory.mktemp("tunnel") / "corridor.npz", length=20.0)


@pytest.fixture(scope="session")
def train_small(tunnel, tmp_path_factory):
    """Trains a small network in the corridor from the command line; returns exit status and run folder."""

    def train(*arguments: str, out: Path | None = None) -> tuple[int, Path]:
        out = out or tmp_path_factory.mktemp("runs") / "run"
        common = ("--task", TASK, "--tunnel", str(tunnel), "--preset", "cpu", "--evaluation-episodes", "100")
        return call(navigate.main, *common, *SMALL, "--out", str(out), *arguments), out

    return train


@pytest.fixture(scope="session")
def trained(train_small, tmp_path_factory) -> Path:
    """A run folder in which the corridor has been learnt, by one of the workers for all."""
    base = tmp_path_factory.getbasetemp()
    out = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared" / "trained"
    out.parent.mkdir(exist_ok=True)
    with FileLock(f"{out}.lock"):
        if not (out / "evaluation.json").exists():
            assert train_small("--steps=250000", "--stop-patience=5", out=out)[0] == 0
    return out


@pytest.fixture
def collected():
    """Collects the failed tasks of the storage library where nobody parses.

    They log their traceback as they are collected. Formatting it parses source lines, and in CPython before 3.11.8 two
    parsers at once, tyro's of a docstring and that one, end in "AST constructor recursion depth mismatch".
    """
    yield
    gc.collect()


def log_without_timing(run: Path) -> list[dict]:
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if name != "timing"} for line in lines]
