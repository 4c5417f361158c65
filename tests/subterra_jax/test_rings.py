"""Counting rings: on walls written down here, with odometry that is wrong by more than a ring."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from subterra_jax.baselines.rings import loop as rings
from subterra_jax.baselines.rings.walls import fit_careful, fit_plain, side_beams
from tests.subterra_jax.ringscans import ANGLE, HALF_WIDTH, N_BEAMS, PITCH, scans


@jax.jit
def track(ranges, moved, direction, pitch):
    def step(now, seen):
        now = rings.advance(now, *seen, pitch)
        return now, now

    return jax.lax.scan(step, rings.start((), N_BEAMS), (ranges, moved, direction))[1]


def drive(there_and_back: bool = False, pockets: bool = True, pitch: float = PITCH, scale: float = 1.03):
    """Truth and track of 120 m at 1.5 m/s, read `scale` times too long; 40 m of it back where asked."""
    rng = np.random.default_rng(4)
    direction = np.ones(800, np.float32)
    if there_and_back:
        direction[530:] = -1.0
    true = np.cumsum(0.15 * direction)
    moved = (0.15 * scale + rng.normal(scale=0.01, size=800)).astype(np.float32)
    return true, track(scans(true, direction, rng, pockets), moved, direction, jnp.float32(pitch))


def test_no_ring_is_lost_or_counted_twice_where_the_odometer_is_out_by_three():
    true, found = drive()
    assert np.abs(found.reckoned[-1] - true[-1]) > 2.0 * PITCH
    assert np.abs(found.station - true).max() < 0.4
    assert np.abs(found.station[-200:] - true[-200:]).mean() < 0.15
    assert found.rate[-1] == pytest.approx(1.0 / 1.03 - 1.0, abs=0.01)
    assert found.strength[-1] > 0.9


def test_the_way_back_is_counted_down_though_left_and_right_have_changed_places():
    true, found = drive(there_and_back=True)
    assert np.abs(found.station - true).max() < 0.4


def test_walls_without_rings_leave_dead_reckoning():
    _, found = drive(pitch=0.0)
    np.testing.assert_allclose(found.station, found.reckoned, atol=1e-3)
    _, smooth = drive(pockets=False)
    assert smooth.strength[-200:].mean() < 0.2
    # A pattern is looked for over 15 m; what that wrongly corrected is given up again.
    assert np.abs(smooth.station - smooth.reckoned)[-100:].mean() < 0.3


def test_standing_still_and_looking_through_a_mouth_change_nothing():
    ranges = jnp.full((50, N_BEAMS), 30.0)
    found = track(ranges, jnp.zeros(50), jnp.ones(50), jnp.float32(PITCH))
    for field in ("station", "rate", "pattern", "seen"):
        np.testing.assert_array_equal(getattr(found, field), 0.0)


def test_a_batch_is_tracked_as_its_members_are():
    rng = np.random.default_rng(7)
    ranges = np.stack([scans(np.array([0.15 * i]), np.ones(1), rng)[0] for i in range(3)])
    moved, direction, pitch = jnp.full(3, 0.15), jnp.ones(3), jnp.array([1.2, 1.35, 0.0])
    advance = jax.jit(rings.advance)
    both = advance(rings.start((3,), N_BEAMS), ranges, moved, direction, pitch)
    for i in range(3):
        one = advance(rings.start((), N_BEAMS), ranges[i], moved[i], direction[i], pitch[i])
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, atol=1e-6), both, one)
    cleared = rings.restart(both, jnp.array([1.0, 0.0, 1.0]))
    assert float(cleared.seen[1]) == 0.0
    assert float(cleared.seen[0]) == pytest.approx(float(both.seen[0]))


def walls_seen(offset: float, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Noiseless ranges from beside the axis of a smooth tunnel, and how far ahead along the axis each beam ends, m."""
    bearing = ANGLE + angle
    with np.errstate(divide="ignore"):
        across = np.where(np.sin(bearing) > 0.0, HALF_WIDTH - offset, HALF_WIDTH + offset)
        ranges = np.minimum(across / np.abs(np.sin(bearing)), 30.0)
    return ranges.astype(np.float32), ranges * np.cos(bearing)


def test_a_careful_look_at_smooth_walls_sees_no_bump_and_places_along_the_axis_not_the_robot():
    ranges, ahead = walls_seen(offset=1.6, angle=0.2)
    found = jax.jit(fit_careful)(jnp.asarray(ranges))
    assert found.valid.all()
    np.testing.assert_allclose(found.height, 0.0, atol=2e-3)
    np.testing.assert_allclose(found.along, ahead[side_beams(N_BEAMS, N_BEAMS)[0]], atol=2e-2)
    # 1.2 m from the left wall and 4.4 m from the right one: along the robot the places are up to 0.9 m off.
    assert np.abs(fit_plain(jnp.asarray(ranges)).along - ahead[side_beams(N_BEAMS, N_BEAMS)[0]]).max() > 0.5


def test_beams_that_end_on_a_box_do_not_move_the_track():
    ranges = np.asarray(scans(np.array([3.0]), np.ones(1), np.random.default_rng(2))[0])
    before = jax.tree.map(lambda leaf: leaf[400], jax.device_get(drive()[1]))
    boxed, missing = np.tile(ranges, (2, 5, 1))
    for i, blocked in enumerate(([4], [2, 3], [3, 4, 5], [4, 12], [2, 3, 13])):
        boxed[i, blocked] *= 0.55
        missing[i, blocked] = 30.0
    step = jnp.float32(0.15), jnp.ones(()), jnp.float32(PITCH)
    advance = jax.jit(
        jax.vmap(lambda scan, careful: rings.advance(before, scan, *step, careful=careful), (0, None)), static_argnums=1
    )
    seen, unseen, fooled = advance(boxed, True), advance(missing, True), advance(boxed, False)
    for field in ("station", "rate", "pattern", "usual", "innovation"):
        np.testing.assert_allclose(getattr(seen, field), getattr(unseen, field), atol=1e-6)
    assert (np.abs(fooled.usual - unseen.usual).max(axis=(1, 2)) > 1e-3).all()
