"""Faults and boxes: none at severity 0, as often and as bad as their params say, where they may stand."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from benchmarks import reference
from subterra_jax.parts import faults, obstacles
from subterra_jax.parts.obstacles import Boxes, distance_along
from subterra_jax.parts.part import uniform_at
from subterra_jax.tunnel import Tunnel

N, BEAMS = 4000, 16
ZERO = faults.FaultParams(
    dropout_rate=0.0, dust_rate=0.0, freeze_rate=0.0, delay=0.0, wet_fraction=0.0, severity_low=4, severity_high=4
)


@functools.cache
def _begin():
    """Faults at the start of episodes; compiled, since eager code would compile every operation."""
    env, params = st.make("Subterra/Faulted-v1", tunnel="control")

    def begin(key, own):
        return env.begin(env.draw_reset(key, (), params), params.replace(faults=own)).faults

    return jax.jit(jax.vmap(begin, (0, None)))


def fresh(params, n=N):
    return _begin()(jax.random.split(jax.random.key(0), n), params)


def run(params, steps, n=N):
    """States after each step, with the time as row of `seen`."""
    advance = jax.jit(jax.vmap(faults.advance_faults, (0, None, 0, None, None)), static_argnums=3)
    state, kept = fresh(params, n), []
    for k in range(steps):
        draw = jax.random.uniform(jax.random.key(10 + k), (n, 5 + BEAMS))
        state = advance(state, jnp.full(6, k + 1.0), draw, BEAMS, params)
        kept.append(state)
    return kept


def each(function, axes):
    """A function of many robots, compiled as a whole."""
    return jax.jit(jax.vmap(function, axes))


def test_every_severity_is_drawn_alike():
    severity = np.asarray(fresh(faults.FaultParams()).severity)
    counts = np.array([(severity == k).sum() for k in range(5)])
    assert counts.sum() == N
    assert np.abs(counts - N / 5).max() < 4 * np.sqrt(N * 0.2 * 0.8)


def test_at_severity_0_nothing_is_corrupted():
    params = faults.FaultParams(severity_low=0, severity_high=0)
    state = run(params, 30)[-1]
    draw = jax.random.uniform(jax.random.key(5), (N, 5 + BEAMS))
    ranges = jnp.full((N, BEAMS), 3.0)
    corrupted = each(faults.corrupt, (0, 0, 0, None, None))(ranges, state, draw, jnp.float32(30.0), params)
    np.testing.assert_array_equal(corrupted, ranges)
    assert not (state.freeze_left > 0.0).any()
    np.testing.assert_array_equal(each(faults.observed, (0, None))(state, params)[:, 0], 30.0)
    np.testing.assert_array_equal(each(faults.grip, (0, None, None))(state, np.float32(5.0), params), 1.0)


def test_dust_reflects_the_stated_share_of_beams_somewhere_before_the_wall():
    params = dataclasses.replace(ZERO, dust_rate=0.15)
    draw = jax.random.uniform(jax.random.key(5), (N, 5 + BEAMS))
    ranges = np.full((N, BEAMS), 3.0, np.float32)
    corrupted = each(faults.corrupt, (0, 0, 0, None, None))(ranges, fresh(params), draw, np.float32(30.0), params)
    short = np.asarray(corrupted)[np.asarray(corrupted) < 3.0]
    assert abs(short.size / corrupted.size - 0.15) < 4 * np.sqrt(0.15 * 0.85 / corrupted.size)
    assert abs(short.mean() - 1.5) < 4 * 3.0 / np.sqrt(12 * short.size)


def test_dropped_beams_are_one_sector_that_reports_the_largest_range():
    params = dataclasses.replace(ZERO, dropout_rate=0.5, dropout_fraction=0.75)
    state = run(params, 5)[-1]
    draw = jnp.zeros(5 + BEAMS)
    corrupted = np.asarray(
        jax.jit(jax.vmap(faults.corrupt, (0, 0, None, None, None)))(
            jnp.full((N, BEAMS), 3.0), state, draw, jnp.float32(30.0), params
        )
    )
    out = corrupted == 30.0
    some = out.any(axis=1)
    assert some.mean() > 0.5
    assert (corrupted[~out] == 3.0).all()
    # One sector: round the turn, beams change from in to out exactly once.
    changes = (out[some] != np.roll(out[some], 1, axis=1)).sum(axis=1)
    assert (changes == 2).all()
    assert out[some].sum(axis=1).max() <= 12


@pytest.mark.parametrize(("name", "longest"), [("dropout", 40.0), ("freeze", 30.0)])
def test_a_fault_begins_as_often_as_its_rate_and_lasts_up_to_its_longest(name, longest):
    params = dataclasses.replace(ZERO, **{f"{name}_rate": 0.02, f"{name}_steps": longest}, spread=0.0)
    left = np.stack([np.asarray(getattr(state, f"{name}_left")) for state in run(params, 60)])
    idle, begins = left[:-1] <= 0.0, (left[:-1] <= 0.0) & (left[1:] > 0.0)
    assert abs(begins.sum() - 0.02 * idle.sum()) < 4 * np.sqrt(0.02 * idle.sum())
    np.testing.assert_array_equal(left[1:][~idle], left[:-1][~idle] - 1.0)
    lengths = left[1:][begins]
    assert (lengths.min(), lengths.max()) == (1.0, longest)
    assert abs(lengths.mean() - 0.5 * (longest + 1.0)) < 4 * lengths.std() / np.sqrt(lengths.size)


def test_observations_are_as_late_as_the_severity_says():
    params = dataclasses.replace(ZERO, delay=4.0)
    state = run(params, 8, n=3)[-1]
    observed = each(faults.observed, (0, None))
    np.testing.assert_array_equal(observed(state, params)[:, 0], 4.0)
    milder = dataclasses.replace(state, severity=jnp.full(3, 2.0))
    np.testing.assert_array_equal(observed(milder, params)[:, 0], 6.0)


def test_wet_rail_takes_the_stated_share_of_the_speed_in_whole_patches():
    params = dataclasses.replace(ZERO, wet_fraction=0.3)
    state = jax.tree.map(lambda leaf: leaf[0], fresh(params, 1))
    places = np.arange(0.0, 20_000.0, 2.5, np.float32)
    grip = np.asarray(each(faults.grip, (None, 0, None))(state, places, params))
    assert set(np.unique(grip)) == {np.float32(0.7), np.float32(1.0)}
    patches = grip.reshape(-1, 4)
    assert (patches == patches[:, :1]).all()
    assert abs((patches[:, 0] < 1.0).mean() - 0.3) < 4 * np.sqrt(0.3 * 0.7 / len(patches))


def test_a_frozen_odometer_loses_what_is_driven_meanwhile():
    always = dataclasses.replace(ZERO, freeze_rate=1.0, freeze_steps=1000.0)
    env, params = st.make("Subterra/Faulted-v1", tunnel="control", faults=always)
    _, state = jax.jit(env.reset)(jax.random.key(0), params)
    start = float(state.station)
    step, readings = jax.jit(env.step), []
    for k in range(6):
        obs, state, *_ = step(jax.random.key(k), state, jnp.array([1.0, 0.0]), params)
        readings.append(float(obs[16]))
    assert readings[0] - float(state.faults.origin[0]) == pytest.approx(0.1, abs=0.05)
    assert np.abs(np.diff(readings)).max() < 0.05  # the noise of its steps alone
    assert float(state.station) - start == pytest.approx(0.6, abs=0.1)


PARAMS = jax.tree.map(jnp.float32, obstacles.ObstacleParams())


def segments(made):
    """The sides of boxes as segments `x0, y0, x1, y1`, m, four to a box."""
    long = made.axis * made.half[:, :1]
    wide = jnp.stack([-made.axis[:, 1], made.axis[:, 0]], axis=-1) * made.half[:, 1:]
    corner = jnp.stack([long + wide, wide - long, -long - wide, long - wide], axis=1) + made.centre[:, None]
    return jnp.concatenate([corner, jnp.roll(corner, -1, axis=1)], axis=-1)


@pytest.fixture(scope="module")
def tunnel():
    return Tunnel.from_plan(st.load_tunnel("subterra-351"), "pockets")


def test_a_beam_from_inside_a_box_meets_it_at_once():
    around = Boxes(jnp.array([[0.1, 0.0]]), jnp.array([[1.0, 0.0]]), jnp.array([[0.5, 0.5]]))
    assert float(distance_along(around, jnp.zeros(2), jnp.array([[1.0, 0.0]]))[0]) == 0.0


def test_scans_among_boxes_agree_with_float64_on_walls_and_boxes_alike(tunnel):
    env, params = st.make("Subterra/Obstructed-v1", "subterra-351", lidar=st.lidar.LidarParams(range_sigma=0.0))
    plan = st.load_tunnel("subterra-351")
    poses = reference.random_poses(plan, 60, np.random.default_rng(0))
    walls = plan.lining("pockets").segments
    _, state = jax.jit(env.reset)(jax.random.key(3), params)
    slots = jnp.arange(int(plan.length / obstacles.PITCH) + 1)
    state = state.replace(obstacles=state.obstacles.replace(start=0.0))  # as if it had begun at the mouth
    own, sizes = state.obstacles, params.obstacles
    sizes = sizes.replace(first=sizes.first + own.start)
    boxes = jax.jit(obstacles.boxes_in)(own.seed, slots, params.tunnel, sizes)
    sides = np.asarray(segments(boxes), np.float64).reshape(-1, 4)
    everything = np.concatenate([walls, sides])
    free = reference.clearance(sides, poses.position) > 0.3
    clearance = jax.jit(jax.vmap(obstacles.Obstacles().clearance, (None, 0, 0, None, None)))
    inside = np.asarray(clearance(own, poses.position, poses.station, params.tunnel, params))
    keep = free & (inside > 0.0)
    assert keep.sum() > 40
    noise = env.draw_step(jax.random.key(0), (60,), params)
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (60, *leaf.shape)), state).replace(
        position=poses.position, heading=poses.heading, station=poses.station
    )
    ranges = np.asarray(jax.jit(jax.vmap(env.observe, (0, 0, None)))(states, noise, params))[:, :16]
    kept = reference.Poses(poses.position[keep], poses.heading[keep], poses.station[keep])
    result = reference.agreement(everything, kept, ranges[keep])
    assert result.n_wrong == 0
    seen = np.abs(ranges[keep] - reference.scan(walls, kept.position, kept.heading)) > 0.01
    assert seen.any(axis=1).mean() > 0.5


def test_there_is_always_a_way_past(tunnel):
    slots = jnp.arange(1, 23)
    seeds = jax.random.bits(jax.random.key(0), (200,))
    boxes = jax.jit(jax.vmap(obstacles.boxes_in, (0, None, None, None)))(seeds, slots, tunnel, PARAMS)
    corners = np.asarray(jax.vmap(segments)(boxes))[..., :2]
    plan = st.load_tunnel("subterra-351")
    free, trolleys = [], 0
    for box, half in zip(corners.reshape(-1, 4, 2), np.asarray(boxes.half).reshape(-1, 2), strict=True):
        if np.abs(box).max() > 1e5:
            continue
        node = np.argmin(np.sum((plan.centre - box.mean(axis=0)) ** 2, axis=1))
        normal = np.array([-plan.tangent[node, 1], plan.tangent[node, 0]])
        across = (box - plan.centre[node]) @ normal
        free.append(max(plan.half_width[node] - across.max(), plan.half_width[node] + across.min()))
        trolley = half[0] > 1.0
        trolleys += trolley
        if not trolley:
            assert 0.15 <= half.min() <= half.max() <= 0.4
    # A curved wall leaves a few centimetres less than a straight one.
    assert min(free) > 1.15
    # One trolley an episode; in some it would have stood in the first metres or beyond the end.
    assert 0.85 * 200 < trolleys <= 200


def test_two_episodes_have_different_boxes_and_one_always_the_same(tunnel):
    slots = jnp.arange(1, 20)
    placed = jax.jit(obstacles.boxes_in)
    a, again, b = (placed(jnp.uint32(seed), slots, tunnel, PARAMS).centre for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, again)
    assert (np.asarray(a) != np.asarray(b)).any(axis=1).mean() > 0.8


def test_numbers_of_places_are_uniform_and_independent():
    u = np.asarray(uniform_at(jnp.uint32(7), jnp.arange(20_000), 0), np.float64)
    v = np.asarray(uniform_at(jnp.uint32(7), jnp.arange(20_000), 1), np.float64)
    counts = np.histogram(u, 20, (0.0, 1.0))[0]
    assert np.sum((counts - 1000.0) ** 2 / 1000.0) < 43.8  # chi² of 19 degrees of freedom, 0.1 %
    assert abs(np.corrcoef(u, v)[0, 1]) < 3 / np.sqrt(20_000)
    assert abs(np.corrcoef(u[1:], u[:-1])[0, 1]) < 3 / np.sqrt(20_000)
