"""Memory and memory maps that a long run of the tests gives back in time."""

import inspect
import platform
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from tests import conftest

ROOT = Path(__file__).parents[1]


@pytest.mark.skipif(conftest._maps() == 0, reason="this system does not count memory maps")
def test_programs_are_forgotten_before_memory_maps_run_out(monkeypatch):
    kept = [jax.jit(lambda x, k=k: jnp.sort(jnp.sin(k * x) @ x.T, axis=0)) for k in range(20)]
    before = conftest._maps()
    for function in kept:
        function(jnp.ones((8, 8)))
    full = conftest._maps()
    assert full >= before + 100, "a program takes some maps"
    conftest.forget_programs_where_maps_run_short()
    assert conftest._maps() >= (before + full) / 2, "far from the limit all is kept"
    monkeypatch.setattr(conftest, "_map_limit", lambda: full)
    conftest.forget_programs_where_maps_run_short()
    assert conftest._maps() < (before + full) / 2


def test_the_watch_looks_after_some_programs(monkeypatch):
    looks = []
    monkeypatch.setattr(conftest, "forget_programs_where_maps_run_short", lambda: looks.append(1))
    watch = inspect.unwrap(conftest.bounded_maps)
    for programs, expected in ((1, 0), (conftest._MANY_PROGRAMS, 1)):
        monkeypatch.setattr(conftest, "_since_looked", 0)
        turn = watch()
        next(turn)
        for k in range(programs):
            jax.jit(lambda x, k=k: x + k)(1.0)
        with pytest.raises(StopIteration):
            next(turn)
        assert len(looks) == expected


@pytest.mark.skipif(conftest.resident() == 0 or platform.libc_ver()[0] != "glibc", reason="the system keeps memory")
def test_memory_is_given_back_so_that_files_after_a_large_one_keep_their_programs():
    code = "\n".join([
        "from tests import conftest",
        "blocks = [bytearray(1000) for _ in range(300_000)]",
        "last = bytearray(1000)",  # what lies behind it would go back to the system by itself
        "del blocks",
        "before = conftest.resident()",
        "conftest.forget_programs()",
        "assert conftest.resident() < before - 0.2e9, (before, conftest.resident())",
    ])  # fmt: skip
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_what_the_list_of_slow_tests_names_is_there():
    lines = [line for line in conftest.SLOW.read_text().splitlines() if not line.startswith("#")]
    assert lines == sorted(set(lines))
    for line in lines:
        file, _, name = line.partition("[")[0].partition("::")
        assert f"def {name}" in (ROOT / file).read_text(), line
