"""Every threshold of a build is listed in one place, with its unit and reason."""

import subprocess
import sys

from scene.limits import list_limits


def test_every_threshold_has_words():
    found = list(list_limits())
    assert len(found) > 300
    assert [(limit.part, limit.name) for limit in found if not limit.words] == []
    assert len({one.part.split(".")[0] for one in found}) == 6  # packages


def test_the_command_prints_those_that_are_asked_for():
    command = [sys.executable, "-m", "scene.limits", "fitting.floor"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert all(line.startswith("fitting.floor ") for line in shown)
    assert any("_LOWER = 0.05  # m" in line for line in shown)
