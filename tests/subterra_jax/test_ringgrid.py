"""Counting rings through faults: on walls written down here, with wet rail, dropouts, dust and data that are late."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines.reckoning import StepDistances
from subterra_jax.baselines.registry import make_agent
from subterra_jax.baselines.rings import grid as ringgrid
from subterra_jax.baselines.steering import CentreLine, Corridor, PacedSteering, PaceMemory
from subterra_jax.evaluation import evaluate, listed_episodes
from tests.subterra_jax.ringscans import N_BEAMS, PITCH, scans

STEPS, DELAY = 640, 4


def drive(wet=(), back=False, pockets=True, faults=False, pitch=PITCH, scale=1.03):
    """Truth, and what is observed, of 100 m: wheels turn 0.15 m a step and the odometer reads `scale` times that."""
    rng = np.random.default_rng(4)
    direction = np.ones(STEPS, np.float32)
    direction[430:] = -1.0 if back else 1.0
    true = np.zeros(STEPS)
    for k in range(1, STEPS):
        grip = 0.7 if any(low <= true[k - 1] < high for low, high in wet) else 1.0
        true[k] = true[k - 1] + 0.15 * grip * direction[k]
    command = np.full(STEPS, 0.15, np.float32)
    command[0] = 0.0
    read = np.where(command > 0.0, 0.15 * scale + rng.normal(scale=0.01, size=STEPS), 0.0)
    ranges = scans(true, direction, rng, pockets)
    if faults:
        ranges = np.where(rng.random(ranges.shape) < 0.15, ranges * rng.random(ranges.shape), ranges)
        out = (np.arange(STEPS) % 80 < 20)[:, None] & (np.arange(N_BEAMS) < 7)
        late = np.maximum(np.arange(STEPS) - DELAY, 0)
        ranges, read = np.where(out, 30.0, ranges)[late], np.where(np.arange(STEPS) < DELAY, 0.0, read[late])
        read[300:320] = 0.0
    return true, (ranges.astype(np.float32), command, read.astype(np.float32), direction, np.full(STEPS, pitch))


CASES = {
    "dry": {},
    "wet": {"wet": ((20, 30), (50, 70))},
    "wet again": {"wet": ((20, 30), (50, 70))},
    "wet at once": {"wet": ((0, 10), (60, 70))},
    "all faults": {"wet": ((30, 40),), "faults": True},
    "there and back": {"wet": ((30, 40),), "back": True},
    "smooth": {"pockets": False},
    "no rings": {"pitch": 0.0, "scale": 1.0},
}


@pytest.fixture(scope="module")
def tracked():
    """Truth and track of each case, and the last track; all of them at once."""
    cases = [drive(**case) for case in CASES.values()]
    seen = [jnp.asarray(np.stack(part, axis=1), jnp.float32) for part in zip(*(case[1] for case in cases), strict=True)]

    def step(now, seen):
        ranges, command, read, direction, pitch = seen
        grid = ringgrid.advance(now, ranges, StepDistances(command, read), direction, pitch)
        kept = {name: getattr(grid, name) for name in ("station", "reckoned", "rate", "strength", "spread", "wet")}
        return grid, kept

    begun = ringgrid.start((len(CASES),), N_BEAMS)
    grid, kept = jax.jit(lambda: jax.lax.scan(step, begun, tuple(seen)))()
    found = {
        name: (cases[i][0], {key: np.asarray(part[:, i]) for key, part in kept.items()}) for i, name in enumerate(CASES)
    }
    return found, grid


@pytest.mark.parametrize("case", ["dry", "wet", "wet at once", "all faults", "there and back"])
def test_no_ring_is_lost_on_wet_rail_nor_without_beams_nor_with_data_that_are_late(tracked, case):
    true, found = tracked[0][case]
    assert np.abs(found["station"] - true)[100:].max() < 0.6
    assert np.abs(found["station"] - true)[-100:].mean() < 0.3
    assert found["strength"][-1] > 0.9
    assert found["spread"][-100:].mean() < 0.2


@pytest.mark.parametrize("case", ["wet", "wet at once", "all faults"])
def test_dead_reckoning_alone_loses_rings_on_wet_rail(tracked, case):
    true, found = tracked[0][case]
    assert np.abs(found["reckoned"] - true)[-100:].mean() > 2.0


def test_wet_rail_is_told_from_dry_once_the_pattern_is_known(tracked):
    true, found = tracked[0]["wet"]
    inside = ((true > 22.0) & (true < 29.0)) | ((true > 52.0) & (true < 69.0))
    outside = (true > 12.0) & ~((true > 19.0) & (true < 32.0)) & ~((true > 49.0) & (true < 72.0))
    assert found["wet"][inside].mean() > 0.8
    assert found["wet"][outside].mean() < 0.2
    assert tracked[0]["dry"][1]["wet"][100:].mean() < 0.1


def test_the_error_of_the_odometer_is_learnt_on_dry_rail(tracked):
    _, found = tracked[0]["dry"]
    # Command and odometer together are 1.8 % too long.
    assert found["rate"][-200:].mean() == pytest.approx(1.0 / 1.018 - 1.0, abs=0.01)


def test_walls_without_rings_leave_dead_reckoning(tracked):
    _, found = tracked[0]["no rings"]
    np.testing.assert_allclose(found["station"], found["reckoned"], atol=1e-3)
    _, smooth = tracked[0]["smooth"]
    assert smooth["strength"][-200:].mean() < 0.2


def test_a_member_of_a_batch_is_tracked_whatever_its_neighbours_are(tracked):
    for one, other in zip(tracked[0]["wet"], tracked[0]["wet again"], strict=True):
        jax.tree.map(np.testing.assert_array_equal, one, other)


def test_who_begins_anew_is_as_at_the_start_and_who_does_not_is_as_before(tracked):
    after = tracked[1]
    cleared = jax.jit(ringgrid.restart)(after, jnp.ones(len(CASES)).at[1].set(0.0))
    begun = jax.jit(lambda: ringgrid.start((), N_BEAMS))()
    jax.tree.map(lambda part, fresh: np.testing.assert_array_equal(part[1], fresh), cleared, begun)
    jax.tree.map(lambda part, kept: np.testing.assert_array_equal(part[2], kept[2]), cleared, after)


def test_the_agent_drives_slowly_where_it_learns_and_faster_where_it_counts():
    params = st.make("Subterra/Faulted-v1")[1]
    steering = make_agent("ring-filter", params).steering
    assert isinstance(steering, PacedSteering)
    blind = PacedSteering(CentreLine(), steering.cruise, steering.slow, steering.learning)

    @jax.jit
    def speed(driven, wanted):
        return blind.steer(PaceMemory(Corridor(*jnp.asarray([2.8, 2.8, 0.0])), driven), wanted, params)[0]

    found = [float(speed(driven, wanted)) for driven, wanted in ((1.0, 2.0), (20.0, 2.0), (20.0, 0.1))]
    assert found == pytest.approx([steering.slow, steering.cruise, 0.1])


@pytest.mark.slow
def test_most_goals_are_found_under_faults_without_a_map():
    env, params = st.make("Subterra/Faulted-v1", estimates=True)
    agent = make_agent("ring-filter", params)
    assert not agent.uses_map
    records = evaluate(env, params, agent, listed_episodes(env, params, 25), 25)
    assert np.mean(records.success) >= 0.84
    assert not np.any(records.contact)
