"""A tunnel continued by copies of itself is still a tunnel."""

from dataclasses import replace

import numpy as np
import pytest

import subterra_jax as st
from benchmarks.throughput.measure import measure_exactness
from benchmarks.throughput.variants import extend_tunnel


@pytest.fixture(scope="module")
def plan() -> st.TunnelPlan:
    whole = st.load_tunnel()
    return replace(whole, linings={name: whole.lining(name) for name in ("smooth", "pockets")})


def test_a_shorter_one_is_a_slice(plan):
    part = extend_tunnel(plan, 100.0)
    assert part.length == pytest.approx(100.0)
    np.testing.assert_allclose(part.centre[0], plan.centre[0])


def test_ten_in_a_row_are_ten_times_as_long_and_have_no_kink(plan):
    long = extend_tunnel(plan, 3510.0)
    assert long.length == pytest.approx(3510.0)
    step = np.diff(long.centre, axis=0)
    spacing = np.linalg.norm(step, axis=1)
    np.testing.assert_allclose(spacing, long.station[1], rtol=0.01)
    turn = np.abs(np.diff(np.unwrap(np.arctan2(step[:, 1], step[:, 0]))))
    original = np.diff(plan.centre, axis=0)
    assert turn.max() < np.abs(np.diff(np.unwrap(np.arctan2(original[:, 1], original[:, 0])))).max() + 0.01
    np.testing.assert_allclose(np.linalg.norm(long.tangent, axis=1), 1.0, atol=1e-9)


def test_left_stays_left_and_walls_keep_their_distance(plan):
    long = extend_tunnel(plan, 900.0)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        wall = getattr(long.lining("smooth"), side)
        assert np.all(np.diff(wall.station) >= 0.0)
        centre, tangent = (
            np.stack([np.interp(wall.station, long.station, v[:, k]) for k in (0, 1)], axis=1)
            for v in (long.centre, long.tangent)
        )
        offset = wall.vertex - centre
        lateral = sign * (tangent[:, 0] * offset[:, 1] - tangent[:, 1] * offset[:, 0])
        half_width = np.interp(wall.station, long.station, long.half_width)
        assert np.abs(lateral - half_width).max() < 0.4
        assert np.median(np.abs(lateral - half_width)) < 0.05


def test_it_does_not_meet_itself(plan):
    long = extend_tunnel(plan, 3510.0)
    node = long.centre[:: max(1, len(long.centre) // 700)]
    station = np.linspace(0.0, long.length, len(node))
    distance = np.hypot(*(node[:, None, k] - node[None, :, k] for k in (0, 1)))
    assert distance[np.abs(station[:, None] - station[None, :]) > 100.0].min() > 70.0


def test_its_lidar_is_exact_across_the_seams(plan):
    long = extend_tunnel(plan.slice(0.0, 40.0), 110.0)
    _, params = st.make("Subterra/Traverse-v1", long)
    gate = measure_exactness(long, "pockets", params, 300, seed=0)
    assert gate.n_wrong == 0
    assert gate.n_rays == 4800
