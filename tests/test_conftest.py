"""What the tests agree on among themselves."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests import conftest

ROOT = Path(__file__).parents[1]


def test_what_the_list_of_slow_tests_names_is_there():
    lines = [line for line in conftest.SLOW.read_text().splitlines() if not line.startswith("#")]
    assert lines == sorted(set(lines))
    for line in lines:
        file, _, name = line.partition("[")[0].partition("::")
        assert f"def {name}" in (ROOT / file).read_text(), line


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_arrays_have_the_shapes_and_dtypes_that_annotations_say():
    """In a whole run other rooms have imported the simulator before it could be checked: see its `conftest.py`."""
    code = (
        "import sys, pytest, tests.subterra_jax.conftest as room; assert room._FIRST;"
        "sys.exit(pytest.main(['-q', '-p', 'no:xdist', '-p', 'no:cacheprovider', 'tests/subterra_jax/test_env.py']))"
    )
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout
