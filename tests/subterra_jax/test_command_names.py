"""The command `subterra` reaches each of the project's commands, and says what it lacks."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import subterra_jax
from subterra_jax import list_tasks
from subterra_jax.__main__ import COMMANDS

PACKAGE = Path(subterra_jax.__file__).parent


def run(*words: str, path: Path = PACKAGE.parent, **env: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "subterra_jax", *words],
        capture_output=True, text=True, timeout=120, check=False, env={**os.environ, "PYTHONPATH": str(path), **env},
        cwd="/",
    )  # fmt: skip


def test_tasks_are_listed_and_help_fits_a_screen():
    assert run("tasks").stdout.split() == list(list_tasks())
    help_page = run("--help").stdout
    assert all(name in help_page for name in COMMANDS)
    assert len(help_page.splitlines()) <= 24


def test_a_command_is_run_with_its_words_from_anywhere(tmp_path):
    done = run("record", "--task", "NoSuch-v1", "--out", str(tmp_path / "x.mcap"))
    assert done.returncode == 2
    assert "NoSuch-v1" in done.stderr
    assert "--length" in run("survey", "--help").stdout


@pytest.mark.parametrize(("words", "part"), [(["tain"], "train"), (["train"], "checkout")])
def test_what_cannot_be_run_is_said_in_one_sentence(tmp_path, words, part):
    (tmp_path / "subterra_jax").symlink_to(PACKAGE)  # as a wheel lays it out, without the other rooms
    if words == ["train"]:
        (tmp_path / "subterra_jax").unlink()
        shutil.copytree(PACKAGE, tmp_path / "subterra_jax", ignore=shutil.ignore_patterns("data", "__pycache__"))
    done = run(*words, path=tmp_path)
    assert done.returncode == 2
    assert part in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
