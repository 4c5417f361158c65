"""Pictures by MuJoCo, each drawn in a process of its own: it chooses how to draw when it is imported."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest


def draw(code: str, file: Path, *words: str) -> tuple[np.ndarray, str]:
    """The picture that a program saves as its first argument, and what it said; skips where there is no OpenGL."""
    line = [sys.executable, "-c", code, str(file), *words]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if "cannot draw" in done.stderr:
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr
    return np.load(file), done.stderr
