"""What a network with memory is shown: as ever for policies of before, and boxes as `Avoidance` has them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.avoidance import Avoidance
from subterra_jax.policies import boxes, senses
from tests.subterra_jax.test_rings import PITCH, scans

N_STEPS = 24
AMONG_BOXES = senses.Senses("careful", boxes=True)
AVOID = Avoidance()


def observation(ranges, distance=0.0) -> Observed:
    reading = jnp.asarray(distance, jnp.float32)
    goal, pitch = jnp.float32(12.0), jnp.float32(PITCH)
    return Observed(
        flat=ranges, ranges=ranges, distance=reading, heading=jnp.float32(0.01), goal=goal, ring_pitch=pitch
    )


def with_a_box(ranges: np.ndarray, station: np.ndarray, left: float) -> np.ndarray:
    """Scans shortened by a box of 0.6 m whose middle is at station 7 m and so far left of the axis."""
    angle = 2.0 * np.pi * np.arange(16) / 16
    for distance in np.arange(0.3, 9.0, 0.02):
        x, y = station[:, None] + distance * np.cos(angle), distance * np.sin(angle)
        inside = (np.abs(x - 7.0) < 0.3) & (np.abs(y - left) < 0.3)
        ranges = np.where(inside, np.minimum(ranges, distance), ranges)
    return ranges.astype(np.float32)


@pytest.fixture(scope="module")
def drive():
    """Scans and actions of two drives at 1 m/s towards a box, a little left of the axis and a little right of it."""
    station = 0.1 * np.arange(N_STEPS) + 2.0
    clear = scans(station, np.ones(N_STEPS), np.random.default_rng(3))
    ranges = np.stack([with_a_box(clear, station, left) for left in (0.2, -0.2)], axis=1)
    actions = np.tile(np.float32([1.0, 0.05]), (N_STEPS, 2, 1))
    actions[0] = 0.0
    return ranges, actions


@pytest.fixture(scope="module")
def remembered(drive):
    """What the sense remembers and shows after each scan, then after the first scan again, then after a turn."""
    again = np.r_[np.arange(N_STEPS), 0, 1]

    def step(now, seen):
        after = boxes.look(now, *seen)
        return after, (after, boxes.features(after))

    first, turned = np.zeros((2, N_STEPS + 2, 2), bool)
    first[[0, N_STEPS]], turned[N_STEPS + 1] = True, True
    seen = drive[0][again], drive[1][again], jnp.asarray(first), jnp.asarray(turned)
    return jax.device_get(jax.jit(lambda *seen: jax.lax.scan(step, boxes.start((2,), 16), seen)[1])(*seen))


def test_the_sense_of_boxes_is_what_avoidance_remembers(drive, remembered):
    _, params = st.make("Subterra/Obstructed-v1", "subterra-351")

    def step(now, seen):
        after = AVOID.look(now, observation(seen[0]), seen[1], params)
        room, angle = AVOID.room(after, after.corridor.angle, params), AVOID.heading(after, params)
        return after, (after, AVOID.lanes(after, params)[1], room, angle)

    begin = jax.jit(lambda ranges: AVOID.begin(observation(ranges), params))
    follow = jax.jit(lambda begun, *seen: jax.lax.scan(step, begun, seen)[1])
    found, features = jax.tree.map(lambda leaf: leaf[:N_STEPS], remembered)
    assert features.shape[-1] == boxes.N_FEATURES
    for i in range(2):
        ranges, actions = drive[0][:, i], drive[1][:, i]
        wanted, free, room, angle = jax.device_get(follow(begin(ranges[0]), ranges, actions))
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            np.testing.assert_allclose(one[:, i], other, atol=1e-4)
        np.testing.assert_allclose(features[:, i, :17], free / AVOID.look_ahead, atol=1e-4)
        np.testing.assert_allclose(features[:, i, 17], wanted.lane - wanted.corridor.offset, atol=1e-4)
        np.testing.assert_allclose(features[:, i, 21], np.minimum(room, 3.0) / 2.0, atol=1e-4)
        np.testing.assert_allclose(features[:, i, 23], angle - wanted.corridor.angle, atol=1e-4)


def test_lanes_through_a_box_are_free_as_far_as_it_stands(remembered):
    lane, free = np.linspace(-1.0, 1.0, 17) * (2.8 - 0.55), 4.0 * remembered[1][N_STEPS - 1, :, :17]
    ahead = 7.0 - 0.3 - (2.0 + 0.1 * (N_STEPS - 1))
    for i in range(2):
        # The beam straight ahead alone meets the box; its hit, and half the robot's width, lie on the axis.
        np.testing.assert_allclose(free[i, np.abs(lane) < 0.45], ahead, atol=0.2)
        np.testing.assert_allclose(free[i, np.abs(lane) > 0.7], 4.0)
        assert abs(2.0 * remembered[1][N_STEPS - 1, i, 18]) > 0.5


def test_what_is_remembered_of_boxes_begins_anew_with_an_episode_and_turns_with_the_robot(remembered):
    memory, _ = remembered
    first, last, again, back = (jax.tree.map(lambda x, k=k: x[k], memory) for k in (0, N_STEPS - 1, N_STEPS, -1))
    assert (last.along > 0.0).sum() > 10
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(first), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(np.abs(back.corridor.angle), np.pi, atol=0.1)
    seen = np.abs(back.along) < 100.0
    assert seen.any()
    assert (back.along[seen] < 0.0).all()


def test_dead_reckoning_among_boxes_counts_what_is_driven_along_the_axis(drive):
    look = jax.jit(senses.look)
    part = {"ranges": drive[0][0, 0], "odometry": jnp.zeros(2), "goal": jnp.full(1, 20.0), "ring_pitch": jnp.zeros(1)}
    sight = look(part, 0.0, senses.start((), 16, AMONG_BOXES))
    assert AMONG_BOXES.n_beams(sight.features.shape[-1]) == 16
    now = jax.jit(senses.advance)(sight.reckoning, jnp.array([1.0, 0.0]), False)
    walls = dataclasses.replace(now.boxes.corridor, angle=jnp.float32(1.0))
    now = now.replace(boxes=dataclasses.replace(now.boxes, corridor=walls))
    seen = look({**part, "odometry": jnp.array([0.1, 0.0])}, 0.0, now)
    angle = float(seen.reckoning.boxes.corridor.angle)
    assert angle > 0.5
    assert seen.station == pytest.approx(0.1 * np.cos(angle), abs=1e-4)


def test_a_tracker_that_there_is_not_is_refused_by_name():
    with pytest.raises(ValueError, match=r"tracker must be one of loop, careful.*, got 'nobody'"):
        senses.start((), 16, senses.Senses("nobody"))
