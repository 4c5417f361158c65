"""Boxes around pieces of wall: known rectangles, lids over pockets, and windows found by brute force."""

import numpy as np
import pytest

from subterra_jax.tunnel import blocks, from_centreline
from subterra_jax.tunnel.order import order, windows


def test_a_pocket_gets_a_lid_and_a_deep_wide_niche_does_not():
    def wall(depth: float) -> np.ndarray:
        return np.array([[0.0, 0.0], [0.5, 0.0], [0.5, depth], [1.5, depth], [1.5, 0.0], [2.0, 0.0]])

    pieces = np.stack([wall(0.13), wall(1.0), wall(0.13)])
    hull, size = blocks.add_lids(pieces, np.full(3, 6), np.array([-1.0, -1.0, 0.0]))
    assert size.tolist() == [2, 6, 6]
    np.testing.assert_array_equal(hull[0, :2], [[0.0, 0.0], [2.0, 0.0]])


def test_a_beam_visits_few_blocks_of_a_straight_tunnel():
    """The bound at a block of a straight tunnel is its own near end, but for the block beside it."""
    plan = from_centreline([[0.0, 0.0], [200.0, 0.0]], 2.5)
    cut = blocks.build_blocks(plan, plan.lining("smooth"), 2.0, 16)
    visits = order(plan, cut, *windows(plan, cut, 30.0))
    assert np.hypot(*cut.half.T).max() == pytest.approx(1.0, abs=0.3)
    assert min(visits.ahead.min(), visits.behind.min()) > -2.1
