"""Memory maps that a long run of the tests gives back in time."""

import inspect

import jax
import jax.numpy as jnp
import pytest

from tests import conftest


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
