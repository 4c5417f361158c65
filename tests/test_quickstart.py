"""The README's Python runs as printed."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def test_the_readme_has_python_in_it():
    assert BLOCKS


@pytest.mark.parametrize("index", range(len(BLOCKS)))
def test_a_block_of_the_readme_runs(index):
    """In a process of its own, as a reader would."""
    done = subprocess.run(
        [sys.executable, "-c", BLOCKS[index]], capture_output=True, text=True, timeout=200, check=False
    )
    assert done.returncode == 0, done.stderr


def test_every_command_of_the_readme_exists():
    for module in sorted(set(re.findall(r"python -m ((?:scene|train|benchmarks)[\w.]*)", README))):
        path = Path(__file__).parents[1].joinpath(*module.split("."))
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), module
