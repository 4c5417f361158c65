"""The list of slow tests, held against the files that it names."""

from pathlib import Path

from tests import conftest

ROOT = Path(__file__).parents[1]


def test_what_the_list_of_slow_tests_names_is_there():
    lines = [line for line in conftest.SLOW.read_text().splitlines() if not line.startswith("#")]
    assert lines == sorted(set(lines))
    for line in lines:
        file, _, name = line.partition("[")[0].partition("::")
        assert f"def {name}" in (ROOT / file).read_text(), line
