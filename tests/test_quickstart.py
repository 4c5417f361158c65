"""The README's Python runs as printed."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
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
        path = ROOT.joinpath(*module.split("."))
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), module
    targets = set(re.findall(r"\bmake ([a-z-]+)(?=[ `])", README))
    assert {"demo", "test"} <= targets
    for target in targets:
        assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE), target


def test_every_link_and_every_room_of_the_readme_exists():
    links = re.findall(r"\]\((?!https?:)([^)#]+)", README)
    assert len(links) >= 10
    for path in links:
        assert (ROOT / path).exists(), path
    design = (ROOT / "docs" / "design.md").read_text()
    rooms = re.findall(r"^\| `([\w/]+/)` \|", design, re.MULTILINE)
    assert len(rooms) >= 5
    for room in rooms:
        assert (ROOT / room).is_dir(), room
