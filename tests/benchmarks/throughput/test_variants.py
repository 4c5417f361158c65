"""What a step costs in longer tunnels and in other linings."""

import pytest

import subterra_jax as st
from benchmarks.throughput.config import ThroughputConfig
from benchmarks.throughput.timing import Timing
from benchmarks.throughput.variants import measure_lengths, measure_linings

CONFIG = ThroughputConfig(study_n=4, poses=400, lengths=(60.0, 110.0), linings=("smooth", "pockets"))
TIMING = Timing(steps=2, repeats=2)


def test_lengths_are_timed_in_turn_in_tunnels_of_these_lengths_with_an_exact_lidar():
    short, long = measure_lengths(CONFIG, TIMING)
    assert (short.name, long.name) == ("60 m", "110 m")
    assert long.n_segments == pytest.approx(short.n_segments * 110 / 60, rel=0.15)
    assert short.cost == (1.0, 1.0, 1.0)
    assert [(one.exactness.n_rays, one.exactness.n_wrong) for one in (short, long)] == [(640, 0)] * 2


def test_linings_are_timed_in_turn_in_the_same_tunnel():
    smooth, pockets = measure_linings(st.load_tunnel().slice(0.0, 40.0), CONFIG, TIMING)
    assert pockets.n_segments > smooth.n_segments
    assert pockets.exactness.n_wrong == smooth.exactness.n_wrong == 0
    assert min(pockets.cost) > 0.0
