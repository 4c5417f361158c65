"""The examples and the notebook run."""

import importlib
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

import subterra_jax as st
from tests.subterra_jax.tunnels import write_corridor

pytestmark = pytest.mark.door

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
TASK = "Subterra/TraverseShort-v1"
NEEDS = {"brax_ppo": "brax", "sb3_ppo": "stable_baselines3", "cleanrl_like": "torch", "rejax_ppo": "rejax"}
TRAINERS = (*NEEDS, "purejaxrl_like")


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    """Episodes of two seconds in a corridor, so that a score takes no time."""
    path = write_corridor(tmp_path_factory.mktemp("tunnel") / "corridor.npz", length=20.0)
    return {"tunnel": str(path), "horizon": 20}


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAINERS)
def test_a_trainer_learns_from_two_updates_and_is_scored_after_each(name, options, monkeypatch):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    monkeypatch.syspath_prepend(str(EXAMPLES))
    trainer, watch = importlib.import_module(name), importlib.import_module("watch")
    for setting, value in (("N_ENVS", 8), ("N_STEPS", 16), ("N_MINIBATCHES", 2), ("N_EPOCHS", 1)):
        if hasattr(trainer, setting):
            monkeypatch.setattr(trainer, setting, value)
    update = trainer.N_ENVS * trainer.N_STEPS if hasattr(trainer, "N_ENVS") else 8192
    monkeypatch.setattr(watch, "N_FRESH", 4)
    seen = jax.numpy.linspace(0.1, 3.0, st.make(TASK, **options)[0].observation_size(st.make(TASK)[1]))
    commands = []

    class Looked(watch.Watch):
        """Notes what each policy commands at one observation."""

        def __call__(self, steps, agent):
            commands.append(np.asarray(agent.function(agent.weights, seen)))
            return super().__call__(steps, agent)

    looked = Looked(TASK, goal=2.0, **options)
    trainer.train(looked, 2 * update, seed=0)
    assert len(looked.scores) >= 2
    assert looked.scores[0].steps == update
    assert np.isfinite(commands).all()
    assert not np.allclose(commands[0], commands[-1], atol=1e-6), "the policy does not change"
    assert 0.0 <= looked.listed(2)["success"] <= 1.0


ROOT = Path(__file__).parents[1]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_notebook_builds_steps_trains_and_plots(tmp_path):
    import nbformat
    from nbclient import NotebookClient

    for room in ("scene", "subterra_jax", "train"):
        (tmp_path / room).symlink_to(ROOT / room)
    shutil.copy(ROOT / "docs" / "notebook.ipynb", tmp_path)
    notebook = nbformat.read(tmp_path / "notebook.ipynb", as_version=4)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
    outcome = "".join(output.get("text", "") for output in outputs)
    assert "simulated: 30." in outcome or "simulated: 29." in outcome
    success = float(outcome.split("success of 100 episodes: ")[1].split("%")[0])
    assert success > 80.0
    assert (tmp_path / "out" / "notebook" / "training" / "checkpoint").is_dir()
