"""Boxes around pieces of wall: known rectangles, lids over pockets, and windows found by brute force."""

import functools

import numpy as np
import pytest

import subterra_jax as st
from benchmarks import reference
from subterra_jax.procedural import open_world
from subterra_jax.tunnel import Tunnel, blocks, from_centreline
from subterra_jax.tunnel.order import order, windows


def test_the_box_of_a_turned_rectangle_is_that_rectangle():
    direction = np.array([np.cos(0.3), np.sin(0.3)])
    normal = np.array([-direction[1], direction[0]])
    corners = [[7.0, 3.0] + a * 2.0 * direction + b * 0.25 * normal for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    centre, half, thickness = blocks.thin_boxes(np.array([corners]), np.array([4]))
    np.testing.assert_allclose(centre[0], [7.0, 3.0], atol=1e-6)
    # Which of its sides counts as the long axis is left open.
    assert sorted([np.linalg.norm(half[0]), thickness[0]]) == pytest.approx([0.25, 2.0], abs=3e-5)
    assert min(abs(half[0] @ normal), abs(half[0] @ direction)) < 1e-6


def test_a_box_encloses_its_piece_and_lies_along_a_nearly_straight_one():
    rng = np.random.default_rng(1)
    pieces = np.stack([np.linspace(0.0, 2.0, 9) + np.zeros((50, 1)), rng.normal(0.0, 0.01, (50, 9))], axis=-1)
    centre, half, thickness = blocks.thin_boxes(pieces, np.full(50, 9))
    length = np.linalg.norm(half, axis=1)
    along = half / length[:, None]
    off = pieces - centre[:, None]
    assert (np.abs(np.einsum("nki,ni->nk", off, along)) <= length[:, None] + 1e-9).all()
    across = off[..., 1] * along[:, None, 0] - off[..., 0] * along[:, None, 1]
    assert (np.abs(across) <= thickness[:, None] + 1e-9).all()
    np.testing.assert_allclose(length, 1.0, atol=0.01)
    assert thickness.max() < 0.04


def test_a_pocket_gets_a_lid_and_a_deep_wide_niche_does_not():
    def wall(depth: float) -> np.ndarray:
        return np.array([[0.0, 0.0], [0.5, 0.0], [0.5, depth], [1.5, depth], [1.5, 0.0], [2.0, 0.0]])

    pieces = np.stack([wall(0.13), wall(1.0), wall(0.13)])
    hull, size = blocks.add_lids(pieces, np.full(3, 6), np.array([-1.0, -1.0, 0.0]))
    assert size.tolist() == [2, 6, 6]
    np.testing.assert_array_equal(hull[0, :2], [[0.0, 0.0], [2.0, 0.0]])


def test_windows_hold_every_block_within_reach_found_one_by_one():
    plan = st.load_tunnel("open:straight:val:3").slice(40.0, 90.0)
    cut = blocks.build_blocks(plan, plan.lining("built"), 2.0, 16)
    first, count = windows(plan, cut, 12.0)
    vertex = cut.offset + cut.centre[:, None]
    segments = [np.hstack([v[:-1], v[1:]]) for v in vertex]
    for node in range(0, len(plan.station), 15):
        near = [i for i, s in enumerate(segments) if reference.clearance(s, plan.centre[node : node + 1])[0] < 12.0]
        assert first[node] <= min(near)
        assert max(near) < first[node] + count[node]


def test_a_tunnel_ten_times_as_long_has_no_larger_windows():
    make = functools.partial(open_world.plan, "open:straight:val:3", variants=("built",), solid=False)
    short, long = (Tunnel.from_plan(make(length=length)) for length in (351.0, 3510.0))
    assert float(long.length) == pytest.approx(3510.0)
    assert long.n_scan <= short.n_scan + 4


@pytest.mark.parametrize("name", [None, "open:masonry:train:0", "open:rock:test-unseen:0"])
def test_nothing_still_to_be_visited_lies_before_the_plane_at_a_block(name):
    plan = (st.load_tunnel(name) if name else st.load_tunnel()).slice(100.0, 90.0)
    cut = blocks.build_blocks(plan, plan.lining(plan.default_lining), 2.0, 16)
    first, count = windows(plan, cut, 12.0)
    visits = order(plan, cut, first, count)
    assert np.hypot(*visits.normal.T).max() <= 1.0
    for node in range(0, len(plan.station), 15):
        start = int(visits.start[node])
        for i in range(first[node], first[node] + count[node]):
            later = range(i, first[node] + count[node]) if i >= start else range(first[node], i + 1)
            way, bound = (1.0, visits.ahead[i]) if i >= start else (-1.0, visits.behind[i])
            # Pockets lie behind the lids of their boxes, up to their depth beyond them.
            corner = np.concatenate([_corners(cut, j) for j in later]) - cut.centre[i]
            assert (way * corner @ visits.normal[i]).min() >= bound


def _corners(cut: blocks.Blocks, i: int) -> np.ndarray:
    along = cut.half[i]
    aside = cut.thickness[i] * np.array([-along[1], along[0]]) / np.hypot(*along)
    return cut.centre[i] + np.array([a * along + b * aside for a in (-1.0, 1.0) for b in (-1.0, 1.0)])


def test_a_beam_visits_few_blocks_of_a_straight_tunnel():
    """The bound at a block of a straight tunnel is its own near end, but for the block beside it."""
    plan = from_centreline([[0.0, 0.0], [200.0, 0.0]], 2.5)
    cut = blocks.build_blocks(plan, plan.lining("smooth"), 2.0, 16)
    visits = order(plan, cut, *windows(plan, cut, 30.0))
    assert np.hypot(*cut.half.T).max() == pytest.approx(1.0, abs=0.3)
    assert min(visits.ahead.min(), visits.behind.min()) > -2.1
