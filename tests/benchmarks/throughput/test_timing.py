"""The stopwatch counts what was done, and drops nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from benchmarks.throughput import timing
from benchmarks.throughput.config import ThroughputConfig
from benchmarks.throughput.loops import environment_loop
from benchmarks.throughput.timing import Loop, Timing, digest, measure


def counting(first: float = 0.0) -> Loop:
    """The observation counts steps; nothing else is returned."""
    return Loop(
        reset=lambda key, params: (jnp.full((3,), first), jnp.zeros(3)),
        step=lambda key, carry, params: ((carry[0] + 1.0, carry[1]), jnp.zeros(()), jnp.float32(0.25)),
    )


def test_every_observation_is_in_the_checksum():
    speed = measure(counting(), 3, Timing(steps=4, repeats=2))
    # The call that warms up counts from 0 to 4, so the timed ones see 4..8 and 8..12.
    assert speed.checksum == sum(range(4, 9)) + sum(range(8, 13))
    assert speed.share_done == 0.25
    assert len(speed.steps_per_second) == 2


def test_a_rate_counts_the_steps_of_every_environment(monkeypatch):
    clock = iter(range(0, 100, 2))
    monkeypatch.setattr(timing, "perf_counter", lambda: next(clock))  # each call takes 2 s
    assert measure(counting(), 3, Timing(steps=4, repeats=2)).steps_per_second == [3 * 4 / 2.0] * 2


def test_calls_get_fewer_steps_where_they_would_take_too_long():
    assert measure(counting(), 3, Timing(steps=50, repeats=2, seconds=1e-9)).steps == 1
    assert measure(counting(), 3, Timing(steps=50, repeats=2, seconds=1e9)).steps == 50


def test_what_is_not_finite_stops_the_run():
    with pytest.raises(FloatingPointError, match="n_envs=3"):
        measure(counting(np.inf), 3, Timing(steps=2, repeats=1))


def test_one_number_of_any_observation_changes_the_digest():
    obs = np.random.default_rng(0).uniform(0.0, 30.0, (4, 18)).astype(np.float32)
    bumped = np.tile(obs, (72, 1, 1))
    bumped[np.arange(72), np.arange(72) // 18, np.arange(72) % 18] += 0.05
    assert not np.any(np.asarray(jax.vmap(digest)(bumped)) == np.asarray(digest(obs)))


def test_the_same_seed_measures_the_same_steps():
    loop = environment_loop(*st.make("Subterra/TraverseShort-v1"), 4)
    first, again, other = (measure(loop, 4, Timing(3, 1, seed=seed)).checksum for seed in (0, 0, 1))
    assert first == again
    assert first != other


def test_sizes_are_measured_once_each_and_stop_at_4096_on_a_cpu(monkeypatch):
    assert ThroughputConfig(n=(16, 1, 16)).sizes() == (1, 16)
    assert ThroughputConfig().sizes() == (1, 16, 256, 1024, 4096)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert ThroughputConfig().sizes()[-1] == 262_144
