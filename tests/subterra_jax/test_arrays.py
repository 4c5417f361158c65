"""Tunnels from arrays: their geometry is analytic, tasks run in them, and each mistake is one sentence."""

import functools
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from benchmarks import reference
from subterra_jax import lidar
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.tunnel import stack

LINE = np.column_stack([np.linspace(0.0, 120.0, 121), np.zeros(121)])
ASIDE = np.array([0.0, 2.5])
LEFT, RIGHT = LINE + ASIDE, LINE - ASIDE


def bend(radius, turn=1.0, lead=30.0, offset=0.0):
    """A straight, a bend to the left and a straight, `offset` metres to the left of their middle."""
    angle = np.linspace(0.0, turn, 60)
    arc = np.column_stack([np.sin(angle), 1.0 - np.cos(angle)]) * radius + np.array([lead, 0.0])
    ahead = np.array([np.cos(turn), np.sin(turn)])
    line = np.concatenate([[[0.0, 0.0]], arc, [arc[-1] + lead * ahead]])
    normal = np.array([[0.0, 1.0], *np.column_stack([-np.sin(angle), np.cos(angle)]), [-ahead[1], ahead[0]]])
    return line + offset * normal


_scan = jax.jit(lidar.scan)  # eager code would compile every operation by itself


def ranges(plan, x, y=0.0, heading=0.0, n_beams=4, lining=None):
    tunnel = st.Tunnel.from_plan(plan, lining)
    params = lidar.LidarParams(n_beams=n_beams)
    return np.asarray(_scan(tunnel, jnp.array([x, y]), jnp.float32(heading), jnp.float32(x), params))


@pytest.mark.parametrize("make", ["half widths", "polylines"])
def test_a_straight_corridor_has_analytic_ranges(make):
    plan = st.tunnel.from_centreline(LINE, 2.5) if make == "half widths" else st.tunnel.from_polylines(LEFT, RIGHT)
    # 0.5 m left of the middle of 5 m: 2 m to the left wall and 3 m to the right; along the tunnel nothing in 30 m.
    np.testing.assert_allclose(ranges(plan, 60.0, 0.5), [30.0, 2.0, 30.0, 3.0], atol=1e-3)
    root = np.sqrt(2.0)
    np.testing.assert_allclose(ranges(plan, 60.0, 0.5, np.pi / 4), root * np.array([2.0, 2.0, 3.0, 3.0]), atol=1e-3)
    assert plan.length == pytest.approx(120.0)
    np.testing.assert_allclose(plan.half_width, 2.5, atol=1e-6)
    np.testing.assert_allclose(plan.tangent, np.tile([1.0, 0.0], (len(plan.station), 1)), atol=1e-9)


def test_a_pocket_is_as_deep_and_as_long_as_given():
    plan = st.tunnel.from_centreline(LINE, 2.5, pockets=[[60.0, 1, 0.4, 0.3], [60.0, -1, 0.2, 0.1]])
    assert plan.default_lining == "pockets"
    np.testing.assert_allclose(ranges(plan, 60.0)[[1, 3]], [2.8, 2.6], atol=1e-3)
    np.testing.assert_allclose(ranges(plan, 60.15)[[1, 3]], [2.8, 2.5], atol=1e-3)
    np.testing.assert_allclose(ranges(plan, 60.0, lining="smooth")[[1, 3]], 2.5, atol=1e-3)


def test_the_line_midway_between_bent_walls_is_their_middle():
    plan = st.tunnel.from_polylines(bend(60.0, offset=2.5), bend(60.0, offset=-2.5))
    given = st.tunnel.from_centreline(bend(60.0), 2.5)
    assert plan.length == pytest.approx(given.length, abs=0.1)
    gap = [np.min(np.linalg.norm(given.centre - point, axis=1)) for point in plan.centre]
    assert np.max(gap) < 0.15  # half a step of the grid, and 2 cm
    np.testing.assert_allclose(plan.half_width, 2.5, atol=0.03)
    wall = np.asarray(plan.lining("smooth").left.vertex)
    np.testing.assert_allclose(reference.clearance(given.lining("smooth").segments, wall), 0.0, atol=0.02)


def test_walls_with_niches_keep_a_quiet_centreline():
    niche = np.array([[50.0, 2.5], [50.0, 4.0], [52.0, 4.0], [52.0, 2.5]])
    left = np.concatenate([LEFT[LEFT[:, 0] < 50.0], niche, LEFT[LEFT[:, 0] > 52.0]])
    plan = st.tunnel.from_polylines(left, RIGHT)
    np.testing.assert_allclose(plan.centre[:, 1], 0.0, atol=0.02)
    np.testing.assert_allclose(ranges(plan, 51.0)[[1, 3]], [4.0, 2.5], atol=0.02)


@pytest.mark.parametrize(
    "task", [pytest.param("Subterra/Traverse-v1", marks=pytest.mark.slow), "Subterra/StopAtShort-v1"]
)
def test_a_task_runs_in_a_tunnel_from_arrays_and_in_a_stack_of_them(task):
    plans = [
        st.tunnel.from_centreline(bend(60.0), 2.5, pockets=[[40.0, 1, 0.2, 0.13]]),
        st.tunnel.from_polylines(LEFT, RIGHT),
    ]

    @functools.partial(jax.jit, static_argnums=0)
    def drive(batch, params, action):
        obs, state = batch.reset(jax.random.key(0), params, 8)
        return obs, state.tunnel, batch.step(jax.random.key(1), state, action, params)[:3:2]

    for tunnel in (plans[0], plans):
        env, params = st.make(task, tunnel=tunnel)
        action = np.tile(np.float32([1.0, 0.0, 1.0, 0.0][: env.action_size]), (8, 1))
        obs, number, after = drive(st.AutoReset(env), params, action)
        assert all(np.isfinite(leaf).all() for leaf in (obs, *after))
        assert len(np.unique(number)) == params.tunnel.count
    _, same = st.make(task, tunnel=st.stack([st.Tunnel.from_plan(plan) for plan in plans]))
    assert jax.tree.all(jax.tree.map(np.array_equal, same, params))


ACROSS = [[60.0, -2.5, 60.0, 2.5]]
WALL_ACROSS = np.concatenate([LEFT[:60], [[60.0, -1.0]], LEFT[61:]])
NARROW = np.concatenate([LEFT[:60], [[60.0, 0.3]], LEFT[61:]])
RING = 20.0 * np.column_stack([np.cos(np.linspace(0.0, 7.0, 200)), np.sin(np.linspace(0.0, 7.0, 200))])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: st.tunnel.from_polylines(RIGHT, LEFT), "left and right are swapped"),
        (lambda: st.tunnel.from_polylines(RIGHT, LEFT, centreline=LINE), "left and right are swapped"),
        (lambda: st.tunnel.from_polylines(LEFT, RIGHT[::-1]), "run in opposite directions"),
        (lambda: st.tunnel.from_polylines(LEFT[:60], RIGHT, centreline=LINE), "left goes from station 0.0 to 59.0 m"),
        (lambda: st.tunnel.from_polylines(LEFT, RIGHT + 4.0 * ASIDE), "left and right are swapped"),
        (lambda: st.tunnel.from_polylines(LEFT, RIGHT, centreline=LINE + 4.0 * ASIDE), "not beside the centreline"),
        (lambda: st.tunnel.from_centreline(LINE, 0.4), "narrower than the robot: half_width is 0.40 m"),
        (lambda: st.tunnel.from_polylines(NARROW, RIGHT, centreline=LINE), "at station 60.0 m a wall is 0.30 m"),
        (lambda: st.tunnel.from_polylines(WALL_ACROSS, RIGHT, centreline=LINE), "a wall stands across the way"),
        (lambda: st.tunnel.from_polylines(LEFT, RIGHT, furniture=ACROSS), "a wall stands across the way at station 60"),
        (lambda: st.tunnel.from_centreline(LINE, np.full(7, 2.5)), "half_width has 7 values, the centreline 121"),
        (lambda: st.tunnel.from_centreline(LINE, 2.5, elevation=np.zeros(5)), "elevation has 5 values"),
        (lambda: st.tunnel.from_centreline(np.where(LINE == 7.0, np.nan, LINE), 2.5), r"not finite at index \[7, 0\]"),
        (lambda: st.tunnel.from_centreline(LINE, np.nan), "half_width is not finite$"),
        (lambda: st.tunnel.from_centreline([[0, 0], [50, 0], [50, 50]], 2.5), "at index 1, or has a corner of 90 deg"),
        (lambda: st.Tunnel.from_plan(st.tunnel.from_centreline(LINE + 5e5, 2.5)), "reaches 500120 m from the origin"),
        (lambda: st.tunnel.from_polylines(LEFT, np.full_like(RIGHT, np.inf)), "right is not finite"),
        (lambda: st.tunnel.from_centreline([*LINE, LINE[100]], 2.5), "centreline doubles back at index 120"),
        (lambda: st.tunnel.from_centreline(np.repeat(LINE, 2, axis=0), 2.5), "repeats the vertex at index 0"),
        (lambda: st.tunnel.from_centreline(RING, 2.5), "centreline comes back to itself"),
        (lambda: st.tunnel.from_centreline(bend(2.0), 2.5), "tighter than the half width"),
        (lambda: st.tunnel.from_polylines([*LEFT[:60], *LEFT[40:]], RIGHT, centreline=LINE), "left doubles back at"),
        (lambda: st.tunnel.from_centreline(LINE[:1], 2.5), "at least 2 vertices"),
        (lambda: st.tunnel.from_centreline(LINE[:, :1], 2.5), r"shape \(n, 2\)"),
        (lambda: st.tunnel.from_centreline("line", 2.5), "must hold numbers"),
        (lambda: st.tunnel.from_centreline(LINE, 2.5, pockets=[[50, 1, 1, 0.1], [60, 2, 1, 0.1]]), "side of"),
        (lambda: st.tunnel.from_centreline(LINE, 2.5, pockets=[[50, 1, 1, 0.1], [60, 1, 1, 0]]), "be positive"),
        (lambda: st.tunnel.from_centreline(LINE, 2.5, pockets=[[60, 1, 1, 0.1], [60.5, 1, 1, 0.1]]), "overlap"),
        (lambda: st.tunnel.from_centreline(LINE, 2.5, pockets=[[130.0, 1, 0.2, 0.1]]), "outside the tunnel"),
    ],
)
def test_a_mistake_is_refused_in_one_sentence(make, message):
    with pytest.raises(st.TunnelError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


HAND, POLY = st.tunnel.from_centreline, partial(st.tunnel.from_polylines, centreline=LINE)
BOUNDS = [  # of a number: what is made of it, a value that is taken and one that is not, and why
    (lambda back: POLY([*LEFT[:61], LEFT[60] + [-back, 0.3], *LEFT[61:]], RIGHT), 0.99, 1.01, "left doubles back at"),
    (lambda by: POLY(np.add(LEFT, [by, 0.0]), RIGHT), 2.99, 3.01, "left goes from station 3.0"),
    (lambda by: POLY(LEFT, np.subtract(RIGHT, [by, 0.0])), 2.99, 3.01, "right goes from station -3.0 to 117.0"),
    (lambda y: POLY([*LEFT[:60], [60.0, y], *LEFT[61:]], RIGHT), 0.42, 0.39, "narrower than the robot: at station 60"),
    (lambda y: POLY([*LEFT[:60], [60.0, y], *LEFT[61:]], RIGHT), 0.42, 0.12, "a wall stands across"),
    (lambda width: HAND(LINE, width), 0.401, 0.4, "narrower than the robot: half_width is 0.40"),
    (lambda x: HAND(LINE, 2.5, pockets=[[60, 1, 1, 0.1], [x, 1, 1, 0.1]]), 61.001, 61.0, "overlap"),
    (lambda x: HAND(LINE, 2.5, pockets=[[x, 1, 1, 0.1]]), 0.501, 0.5, "lies outside the tunnel"),
    (lambda x: HAND(LINE, 2.5, pockets=[[x, -1, 1, 0.1]]), 119.499, 119.5, "lies outside the tunnel"),
]


@pytest.mark.parametrize(("make", "taken", "refused", "message"), BOUNDS)
def test_a_number_is_taken_up_to_its_bound(make, taken, refused, message):
    assert make(taken).length == pytest.approx(120.0)
    with pytest.raises(st.TunnelError, match=message):
        make(refused)


def test_a_tunnel_of_20_km_is_checked_in_a_moment():
    """Every node against every wall takes minutes."""
    x = np.arange(-10_000.0, 10_001.0)
    began = time.process_time()
    plan = st.tunnel.from_centreline(np.column_stack([x, 20.0 * np.sin(x / 300.0)]), 2.5)
    assert time.process_time() - began < 20.0
    assert plan.length == pytest.approx(20_022.0, abs=1.0)
    pinched = np.where(x == 9000.0, 0.41, 2.5)
    with pytest.raises(st.TunnelError, match="narrower than the robot: at station"):
        st.tunnel.from_polylines(*(np.column_stack([x, side * pinched - 0.02]) for side in (1.0, -1.0)),
                                 centreline=np.column_stack([x, np.zeros_like(x)]))  # fmt: skip


def ugly_walls(rng: np.random.Generator) -> list[np.ndarray]:
    n = rng.integers(60, 160)
    station = np.linspace(0, rng.uniform(30, 70), n)
    turn = rng.normal(0, rng.choice([0, 0.02, 0.08]), n).cumsum() * 0.1
    heading = np.cumsum(np.clip(turn, -0.1, 0.1))
    tangent = np.stack([np.cos(heading), np.sin(heading)], -1)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], -1)
    centre = np.cumsum(tangent * np.gradient(station)[:, None], axis=0)
    width, fold, rough = rng.uniform(1.5, 3.5), rng.choice([0.0, 0.3, 0.8, 1.5]), rng.choice([0.02, 0.2, 0.5])
    walls = []
    for side in (1, -1):
        wall = centre + side * normal * (width + np.abs(rng.normal(0, rough, n)))[:, None]
        wall = wall + tangent * (rng.uniform(-fold, fold, n) * (rng.random(n) < 0.3))[:, None]
        for k in rng.integers(5, n - 5, rng.integers(0, 4)):
            depth, length = rng.uniform(0.3, 2.5), rng.uniform(0.2, 2.0)
            mouth = 0.5 * length if rng.random() < 0.5 else length
            niche = np.array([[0, 0], [0.2 * length, depth], [length, depth], [mouth, 0]])
            niche = wall[k] + niche @ np.stack([tangent[k], side * normal[k]])
            wall = np.concatenate([wall[:k], niche, wall[k + 1 :]])
        walls.append(wall)
    return walls


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_ugly_tunnels_are_exact_or_refused_in_one_sentence():
    seeds, plans, poses, refusals = [], [], [], []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        try:
            plans.append(st.tunnel.from_polylines(*ugly_walls(rng)))
        except st.TunnelError as error:
            refusals.append(str(error))
            continue
        seeds.append(seed)
        poses.append(reference.random_poses(plans[-1], 400, rng, gap=0.45))
    assert 20 < len(plans) < 60
    assert not any("\n" in refusal for refusal in refusals)
    tunnels = stack([Tunnel.from_plan(plan) for plan in plans])

    @partial(jax.jit, static_argnums=0)
    @partial(jax.vmap, in_axes=(None, None, 0, 0, 0, 0))
    def scan(fused, tunnels, index, position, heading, station):
        return lidar.scan(tunnels.pick(index), position, heading, station, lidar.LidarParams(fused=fused))

    rows = [np.concatenate(part) for part in zip(*(vars(each).values() for each in poses), strict=True)]
    index = np.repeat(np.arange(len(plans)), 400)
    for fused in (True, False):
        ranges = np.asarray(scan(fused, tunnels, index, *rows)).reshape(len(plans), 400, 16)
        for seed, plan, own, found in zip(seeds, plans, poses, ranges, strict=True):
            result = reference.agreement(plan.lining("smooth").segments, own, found)
            assert result.n_wrong == 0, (fused, seed, result)
