"""The notebook runs from top to bottom."""

import shutil
from pathlib import Path

import pytest

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
    told = "".join(output.get("text", "") for output in outputs)
    assert "simulated: 30." in told or "simulated: 29." in told
    success = float(told.split("success of 100 episodes: ")[1].split("%")[0])
    assert success > 80.0
    assert (tmp_path / "out" / "notebook" / "training" / "checkpoint").is_dir()
