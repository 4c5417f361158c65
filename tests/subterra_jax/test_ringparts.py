"""The parts that rings are counted with: walls fitted to a scan, a belief on a grid, the age of what is observed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from subterra_jax.baselines import reckoning
from subterra_jax.baselines.rings import bank
from subterra_jax.baselines.rings import walls as wallfit
from subterra_jax.baselines.rings.walls import Bumps

LEFT, RIGHT, SLOPE = 2.6, 3.0, 0.08
ANGLE = 2.0 * np.pi * np.arange(16) / 16


def room(slope=SLOPE):
    """Ranges between two straight walls at a small angle to the robot, m."""
    with np.errstate(divide="ignore"):
        left, right = LEFT / (np.sin(ANGLE) - slope * np.cos(ANGLE)), RIGHT / (slope * np.cos(ANGLE) - np.sin(ANGLE))
    return np.minimum(np.where(left > 0.0, left, 99.0), np.where(right > 0.0, right, 99.0)).clip(0.0, 30.0)


look = jax.jit(wallfit.track_walls)
begun = jax.tree.map(jnp.asarray, wallfit.begin_walls((), 16))


def fitted(ranges, scans=20):
    walls = begun
    for _ in range(scans):
        walls, bumps = look(walls, jnp.asarray(ranges, jnp.float32), jnp.ones(()))
    return walls, bumps


def test_walls_at_an_angle_are_found_and_nothing_stands_out_of_them():
    walls, bumps = fitted(room())
    np.testing.assert_allclose(walls.distance, [LEFT, RIGHT], atol=0.01)
    assert float(walls.slope) == pytest.approx(SLOPE, abs=0.01)
    assert bool(bumps.valid.all())
    np.testing.assert_allclose(bumps.height, 0.0, atol=0.01)


def test_a_pocket_is_heard_and_beams_that_fall_short_or_see_nothing_do_not_count():
    ranges = room()
    ranges[4] += 0.13  # to the left
    ranges[5], ranges[12], ranges[11] = 1.9, 30.0, 0.4
    walls, _ = fitted(room())
    walls, bumps = look(walls, jnp.asarray(ranges, jnp.float32), jnp.ones(()))
    np.testing.assert_allclose(walls.distance, [LEFT, RIGHT], atol=0.03)
    index = wallfit.side_beams(16)[0]
    assert set(index[~np.asarray(bumps.valid)]) == {5, 11, 12}
    assert float(bumps.height[index == 4][0]) == pytest.approx(0.13, abs=0.03)


def test_other_walls_are_taken_over_at_once_where_most_beams_are_on_them():
    walls, _ = fitted(room())
    walls, bumps = look(
        walls, jnp.asarray(room() + 0.5 / np.maximum(np.abs(np.sin(ANGLE)), 0.5), jnp.float32), jnp.ones(())
    )
    np.testing.assert_allclose(walls.distance, [LEFT + 0.5, RIGHT + 0.5], atol=0.05)
    assert int(bumps.valid.sum()) >= 9


def test_the_age_of_observations_shows_when_the_robot_sets_off():
    commanded = jnp.full(12, 0.1).at[0].set(0.0)
    read = jnp.full(12, 0.11).at[jnp.array([0, 1, 2, 3, 9])].set(0.0)

    def step(lag, both):
        driven, unseen, lag = reckoning.advance_delay(lag, reckoning.StepDistances(*both))
        return lag, (driven, unseen)

    lag, (driven, unseen) = jax.jit(lambda: jax.lax.scan(step, reckoning.begin_delay(()), (commanded, read)))()
    assert float(lag.delay) == 3.0
    np.testing.assert_allclose(driven, [0.0] * 4 + [0.106] * 5 + [0.1] + [0.106] * 2, rtol=1e-5)
    assert float(unseen[-1]) == pytest.approx(0.3)
    assert float(driven.sum() + unseen[-1]) == pytest.approx(0.1 * 11 + 0.006 * 7, rel=1e-4)


predicted = jax.jit(bank.predict)
ON = {wet: np.asarray(jax.jit(bank.begin_belief, static_argnums=(0, 1))((), wet)) for wet in (False, True)}


def test_wet_rail_moves_its_half_of_the_belief_and_no_probability_is_lost():
    belief, zero = 0.5 * ON[False] + 0.5 * ON[True], np.float32(0.0)
    for _ in range(4):
        belief = predicted(belief, np.float32(2.5), zero, zero, zero)
    belief = np.asarray(belief)
    mean = np.sum(belief * bank.CELL, axis=-1) / np.sum(belief, axis=-1)
    np.testing.assert_allclose(mean, [0.0, -10.0], atol=1e-4)
    assert belief.sum() == pytest.approx(1.0, abs=1e-5)
    mixed = np.asarray(predicted(ON[False], zero, np.float32(0.25), zero, np.float32(0.4)))
    np.testing.assert_allclose(mixed.sum(axis=-1), [0.75, 0.25], atol=1e-6)
    assert np.sum(mixed * np.square(bank.CELL)) == pytest.approx(0.4, abs=1e-5)


def test_a_scan_tells_the_phase_and_leaves_the_ring_open():
    flat = np.full((2, bank.CELLS), 0.5 / bank.CELLS, np.float32)
    heard = np.where(np.arange(bank.PHASES) == 7, 0.0, -50.0).astype(np.float32)
    belief, evidence = jax.jit(bank.correct)(flat, heard)
    either = np.asarray(belief).sum(axis=0)
    assert np.flatnonzero(either > 0.1).tolist() == [7 + 48 * k for k in range(bank.RINGS)]
    assert float(evidence) == pytest.approx(-np.log(bank.PHASES), abs=1e-4)
    moved, by = jax.jit(bank.recentre)(ON[False], np.float32(3.2))
    assert float(by) == 3.0
    assert float(moved[0, bank.CELLS // 2 - 3]) == 1.0


def test_a_pattern_is_learnt_and_the_likeliest_phase_is_where_it_was_heard():
    rng, pitch, one = np.random.default_rng(0), jnp.float32(1.35), jnp.ones(())
    relief = lambda place: 0.13 * (np.cos(2.0 * np.pi * place / 1.35) > 0.6)  # noqa: E731
    station = 0.17 * np.arange(153)
    along = np.stack([np.array([2.8, 1.16, 0.0, -1.16, -2.8])] * 2)
    height = relief(station[:, None, None] + along) + rng.normal(scale=0.04, size=(153, 2, 5))

    def step(memory, seen):
        bumps = Bumps(seen[1], jnp.asarray(along, jnp.float32), jnp.ones((2, 5), bool))
        at = bank.ring_phases(seen[0], bumps, one, pitch)
        # What a robot says that believes to be 0.3 m short of where it is.
        behind = bank.ring_phases(seen[0] - 0.3, bumps, one, pitch)
        likely = bank.log_likelihood(memory, memory.pattern, bumps, behind, 16)
        memory, pattern = bank.learn(memory, memory.pattern, bumps, at, one)
        return memory.replace(pattern=pattern), likely

    @jax.jit
    def learnt():
        seen = jnp.asarray(station, jnp.float32), jnp.asarray(height, jnp.float32)
        memory, likely = jax.lax.scan(step, bank.empty_memory(()), seen)
        shape = bank.pattern_heights(memory.pattern, bank.multiples(jnp.zeros((2, 1))), bank.PHASE)
        return bank.pattern_strength(memory, 5), shape[0, 0], likely

    strength, shape, likely = (np.asarray(part) for part in learnt())
    assert strength > 0.9
    assert np.corrcoef(shape, relief(bank.PHASE / (2.0 * np.pi) * 1.35))[0, 1] > 0.9
    best = bank.PHASE[np.argmax(likely[-3:].sum(axis=0))] / (2.0 * np.pi) * 1.35
    assert np.mod(best - 0.3 + 0.675, 1.35) - 0.675 == pytest.approx(0.0, abs=0.06)
