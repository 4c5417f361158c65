"""JaxNav does the same work as ours, or says what it does instead."""

import sys

import jax
import numpy as np
import pytest

from benchmarks.throughput.loops import jaxnav_loop, measure_jaxnav
from benchmarks.throughput.timing import Loop, Timing


def test_a_peer_that_is_not_installed_is_left_out_with_its_reason(monkeypatch):
    monkeypatch.setitem(sys.modules, "jaxmarl", None)
    monkeypatch.setitem(sys.modules, "jaxmarl.environments.jaxnav.jaxnav_env", None)
    peer = measure_jaxnav((1, 2), Timing(), lambda _: None)
    assert peer.speeds == []
    assert "jaxmarl" in peer.left_out["all"]


def test_a_peer_that_breaks_is_left_out_with_its_reason():
    def broken(n_envs: int) -> Loop:
        raise RuntimeError("RESOURCE_EXHAUSTED: 1 TiB" if n_envs > 4 else "no such map")

    peer = measure_jaxnav((4, 8), Timing(), lambda _: None, broken)
    assert peer.left_out == {"4": "RuntimeError: no such map", "8": "out of memory"}
    assert peer.speeds == []


def test_jaxnav_has_as_many_beams_as_ours_and_one_agent():
    pytest.importorskip("jaxmarl")
    loop = jaxnav_loop(3)
    carry = jax.jit(loop.reset)(jax.random.key(0), loop.params)
    (obs, _), rest, done = jax.jit(loop.step)(jax.random.key(1), carry, loop.params)
    assert np.isfinite(float(rest))
    assert 0.0 <= float(done) <= 1.0
    assert {name: value.shape for name, value in obs.items()} == {"agent_0": (3, 16 + 5)}
