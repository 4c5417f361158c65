"""Boxes on the way: where they may stand, and rays and distances against known answers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from benchmarks import reference
from subterra_jax.parts import obstacles
from subterra_jax.parts.obstacles import Boxes, distance_along
from subterra_jax.parts.part import uniform_at
from subterra_jax.tunnel import Tunnel

PARAMS = jax.tree.map(jnp.float32, obstacles.ObstacleParams())


def segments(made):
    """The sides of boxes as segments `x0, y0, x1, y1`, m, four to a box."""
    long = made.axis * made.half[:, :1]
    wide = jnp.stack([-made.axis[:, 1], made.axis[:, 0]], axis=-1) * made.half[:, 1:]
    corner = jnp.stack([long + wide, wide - long, -long - wide, long - wide], axis=1) + made.centre[:, None]
    return jnp.concatenate([corner, jnp.roll(corner, -1, axis=1)], axis=-1)


def square(x=5.0, y=0.0, turn=0.0):
    axis = jnp.array([[np.cos(turn), np.sin(turn)]], jnp.float32)
    return Boxes(jnp.array([[x, y]]), axis, jnp.array([[0.5, 0.5]]))


@pytest.fixture(scope="module")
def tunnel():
    return Tunnel.from_plan(st.load_tunnel("subterra-351"), "pockets")


def test_a_beam_from_inside_a_box_meets_it_at_once():
    assert float(distance_along(square(0.1), jnp.zeros(2), jnp.array([[1.0, 0.0]]))[0]) == 0.0


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


def test_the_clearance_is_the_distance_to_the_nearest_side(tunnel):
    slots = jnp.arange(1, 20)
    boxes = jax.jit(obstacles.boxes_in)(jnp.uint32(5), slots, tunnel, PARAMS)
    sides = np.asarray(segments(boxes), np.float64).reshape(-1, 4)
    plan, compared = st.load_tunnel("subterra-351"), 0
    own, params = (
        obstacles.ObstacleState(jnp.uint32(5), jnp.float32(0.0)),
        st.make("Subterra/Obstructed-v1", "control")[1],
    )
    clearance = jax.jit(lambda at, station: obstacles.Obstacles().clearance(own, at, station, tunnel, params))
    for node in range(40, 1000, 9):
        position = plan.centre[node].astype(np.float32)
        expected = reference.clearance(sides, position[None])[0]
        found = float(clearance(position, jnp.float32(plan.station[node])))
        if 0.0 < found < 0.8 or expected < 0.8:
            assert found in (pytest.approx(expected, abs=1e-4), 0.0)
            compared += 1
    assert compared >= 5


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
