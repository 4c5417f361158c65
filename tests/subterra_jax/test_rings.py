"""Counting rings through faults: on walls written down here, with wet rail, dropouts, dust and data that are late."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines import reckoning
from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.registry import make_agent
from subterra_jax.baselines.rings import filter as rings
from subterra_jax.baselines.rings import pattern
from subterra_jax.baselines.rings import walls as wallfit
from subterra_jax.baselines.rings.walls import Bumps
from subterra_jax.evaluation import evaluate, listed_episodes

STEPS, DELAY = 640, 4
HALF_WIDTH, DEPTH, PITCH, N_BEAMS = 2.8, 0.13, 1.35, 16
ANGLE = 2.0 * np.pi * np.arange(N_BEAMS) / N_BEAMS
ONE = jnp.ones(())


def scans(station: np.ndarray, direction: np.ndarray, rng: np.random.Generator, pockets: bool) -> np.ndarray:
    """Ranges on the axis of a straight tunnel whose left wall has pairs of pockets and whose right wall single ones."""
    with np.errstate(divide="ignore"):
        smooth = np.minimum(HALF_WIDTH / np.abs(np.sin(ANGLE)), 30.0)
    hit = station[:, None] + direction[:, None] * smooth * np.cos(ANGLE)
    left = direction[:, None] * np.sin(ANGLE) > 0.0
    place = np.mod(hit - 0.4, PITCH)
    inside = (np.abs(place - 0.5) < 0.1) | (left & (np.abs(place - 0.9) < 0.1))
    ranges = smooth * np.where(inside & pockets, 1.0 + DEPTH / HALF_WIDTH, 1.0)
    return np.clip(ranges + rng.normal(scale=0.05, size=ranges.shape), 0.0, 30.0)


def drive(wet=(), back=False, pockets=True, faults=False, pitch=PITCH, scale=1.03):
    """Truth, and what is observed, of 100 m: wheels turn 0.15 m a step and the odometer reads `scale` times that."""
    rng = np.random.default_rng(4)
    direction = np.ones(STEPS)
    direction[430:] = -1.0 if back else 1.0
    true = np.zeros(STEPS)
    for k in range(1, STEPS):
        grip = 0.7 if any(low <= true[k - 1] < high for low, high in wet) else 1.0
        true[k] = true[k - 1] + 0.15 * grip * direction[k]
    command = np.where(np.arange(STEPS) > 0, 0.15, 0.0)
    read = np.where(command > 0.0, 0.15 * scale + rng.normal(scale=0.01, size=STEPS), 0.0)
    ranges = scans(true, direction, rng, pockets)
    if faults:
        ranges = np.where(rng.random(ranges.shape) < 0.15, ranges * rng.random(ranges.shape), ranges)
        out = (np.arange(STEPS) % 80 < 20)[:, None] & (np.arange(N_BEAMS) < 7)
        late = np.maximum(np.arange(STEPS) - DELAY, 0)
        ranges, read = np.where(out, 30.0, ranges)[late], np.where(np.arange(STEPS) < DELAY, 0.0, read[late])
        read[300:320] = 0.0
    return true, (ranges, command, np.cumsum(read), direction, np.full(STEPS, pitch))


CASES = {
    "dry": {},
    "wet": {"wet": ((20, 30), (50, 70))},
    "wet at once": {"wet": ((0, 10), (60, 70))},
    "all faults": {"wet": ((30, 40),), "faults": True},
    "there and back": {"wet": ((30, 40),), "back": True},
    "smooth": {"pockets": False},
    "no rings": {"pitch": 0.0, "scale": 1.0},
}


@pytest.fixture(scope="module")
def tracked():
    """Truth and track of each case; all of them at once."""
    cases = [drive(**case) for case in CASES.values()]
    seen = [jnp.asarray(np.stack(part), jnp.float32) for part in zip(*(case[1] for case in cases), strict=True)]

    @jax.jit
    @jax.vmap
    def track(*seen):
        def step(now, seen):
            track, counted, reckoned = now
            ranges, command, reading, direction, pitch = seen
            obs = Observed(ranges, ranges, reading, jnp.zeros(()))
            moved, _, counted = reckoning.reckon(counted, obs, command / 0.1, 0.6, jnp.float32(0.1))
            pending = reckoning.unobserved_distance(counted, jnp.float32(0.1))
            track = rings.advance(track, ranges, moved, direction, pitch, pending=pending)
            reckoned = reckoned + direction * moved
            best, found = jnp.argmax(track.bank.evidence), track.estimate
            kept = {"reckoned": reckoned + direction * pending, "rate": track.bank.rate[best]}
            return (track, counted, reckoned), {**kept, **vars(found)}

        first = Observed(seen[0][0], seen[0][0], jnp.zeros(()), jnp.zeros(()))
        begun = rings.start(N_BEAMS), reckoning.begin_reckoning(first), jnp.zeros(())
        return jax.lax.scan(step, begun, seen)[1]

    kept = jax.tree.map(np.asarray, track(*seen))
    return {name: (cases[i][0], {key: part[i] for key, part in kept.items()}) for i, name in enumerate(CASES)}


@pytest.mark.parametrize("case", ["dry", "wet", "wet at once", "all faults", "there and back"])
def test_no_ring_is_lost_on_wet_rail_nor_without_beams_nor_with_data_that_are_late(tracked, case):
    true, found = tracked[case]
    assert np.abs(found["station"] - true)[100:].max() < 0.6
    assert np.abs(found["station"] - true)[-100:].mean() < 0.3
    assert found["strength"][-1] > 0.9
    assert found["spread"][-100:].mean() < 0.2


@pytest.mark.parametrize("case", ["wet", "wet at once", "all faults"])
def test_dead_reckoning_alone_loses_rings_on_wet_rail(tracked, case):
    true, found = tracked[case]
    assert np.abs(found["reckoned"] - true)[-100:].mean() > 2.0


def test_wet_rail_is_told_from_dry_once_the_pattern_is_known(tracked):
    true, found = tracked["wet"]
    inside = ((true > 22.0) & (true < 29.0)) | ((true > 52.0) & (true < 69.0))
    outside = (true > 12.0) & ~((true > 19.0) & (true < 32.0)) & ~((true > 49.0) & (true < 72.0))
    assert found["wet"][inside].mean() > 0.8
    assert found["wet"][outside].mean() < 0.2
    assert tracked["dry"][1]["wet"][100:].mean() < 0.1


def test_the_error_of_the_odometer_is_learnt_on_dry_rail(tracked):
    # Command and odometer together are 1.8 % too long.
    assert tracked["dry"][1]["rate"][-200:].mean() == pytest.approx(1.0 / 1.018 - 1.0, abs=0.01)


def test_walls_without_rings_leave_dead_reckoning(tracked):
    found = tracked["no rings"][1]
    np.testing.assert_allclose(found["station"], found["reckoned"], atol=1e-3)
    assert tracked["smooth"][1]["strength"][-200:].mean() < 0.2


def test_the_agent_drives_slowly_where_it_learns_and_faster_where_it_counts():
    pace = make_agent("ring-filter", st.make("Subterra/Faulted-v1", tunnel="control")[1]).pace
    assert pace.slow < pace.cruise < 2.0
    found = [float(pace.limit(wanted, driven)) for driven, wanted in ((1.0, 2.0), (20.0, 2.0), (20.0, 0.1))]
    assert found == pytest.approx([pace.slow, pace.cruise, 0.1])


@pytest.mark.slow
def test_most_goals_are_found_under_faults_without_a_map():
    env, params = st.make("Subterra/Faulted-v1", tunnel="subterra-351", estimates=True)
    agent = make_agent("ring-filter", params)
    assert not agent.uses_map
    records = evaluate(env, params, agent, listed_episodes(env, params, 25), 25)
    assert np.mean(records.success) >= 0.84
    assert not np.any(records.contact)


LEFT, RIGHT, SLOPE = 2.6, 3.0, 0.08


def room(slope=SLOPE):
    """Ranges between two straight walls at a small angle to the robot, m."""
    with np.errstate(divide="ignore"):
        left, right = LEFT / (np.sin(ANGLE) - slope * np.cos(ANGLE)), RIGHT / (slope * np.cos(ANGLE) - np.sin(ANGLE))
    return np.minimum(np.where(left > 0.0, left, 99.0), np.where(right > 0.0, right, 99.0)).clip(0.0, 30.0)


look = jax.jit(wallfit.track_walls)


@pytest.fixture(scope="module")
def fitted():
    """The walls of `room` after twenty scans, and the relief of the last."""
    walls, ranges = wallfit.begin_walls(N_BEAMS), jnp.asarray(room(), jnp.float32)
    for _ in range(20):
        walls, bumps = look(walls, ranges, ONE)
    return walls, bumps


def test_walls_at_an_angle_are_found_and_nothing_stands_out_of_them(fitted):
    walls, bumps = fitted
    np.testing.assert_allclose(walls.distance, [LEFT, RIGHT], atol=0.01)
    assert float(walls.slope) == pytest.approx(SLOPE, abs=0.01)
    assert bool(bumps.valid.all())
    np.testing.assert_allclose(bumps.height, 0.0, atol=0.01)


def test_a_pocket_is_heard_and_beams_that_fall_short_or_see_nothing_do_not_count(fitted):
    ranges = room()
    ranges[4] += 0.13  # to the left
    ranges[5], ranges[12], ranges[11] = 1.9, 30.0, 0.4
    walls, bumps = look(fitted[0], jnp.asarray(ranges, jnp.float32), ONE)
    np.testing.assert_allclose(walls.distance, [LEFT, RIGHT], atol=0.03)
    index = wallfit.side_beams(N_BEAMS)[0]
    assert set(index[~np.asarray(bumps.valid)]) == {5, 11, 12}
    assert float(bumps.height[index == 4][0]) == pytest.approx(0.13, abs=0.03)


def test_other_walls_are_taken_over_at_once_where_most_beams_are_on_them(fitted):
    wider = room() + 0.5 / np.maximum(np.abs(np.sin(ANGLE)), 0.5)
    walls, bumps = look(fitted[0], jnp.asarray(wider, jnp.float32), ONE)
    np.testing.assert_allclose(walls.distance, [LEFT + 0.5, RIGHT + 0.5], atol=0.05)
    assert int(bumps.valid.sum()) >= 9


predicted = jax.jit(rings.predict)
ON = [np.asarray(rings.start(N_BEAMS).bank.belief[i]) for i in range(2)]


def test_wet_rail_moves_its_half_of_the_belief_and_no_probability_is_lost():
    belief, zero = 0.5 * ON[0] + 0.5 * ON[1], np.float32(0.0)
    for _ in range(4):
        belief = predicted(belief, np.float32(2.5), zero, zero, zero)
    belief = np.asarray(belief)
    mean = np.sum(belief * rings.CELL, axis=-1) / np.sum(belief, axis=-1)
    np.testing.assert_allclose(mean, [0.0, -10.0], atol=1e-4)
    assert belief.sum() == pytest.approx(1.0, abs=1e-5)
    mixed = np.asarray(predicted(ON[0], zero, np.float32(0.25), zero, np.float32(0.4)))
    np.testing.assert_allclose(mixed.sum(axis=-1), [0.75, 0.25], atol=1e-6)
    assert np.sum(mixed * np.square(rings.CELL)) == pytest.approx(0.4, abs=1e-5)


def test_a_scan_tells_the_phase_and_leaves_the_ring_open():
    flat = np.full((2, rings.CELLS), 0.5 / rings.CELLS, np.float32)
    heard = np.where(np.arange(rings.PHASES) == 7, 0.0, -50.0).astype(np.float32)
    belief, evidence = jax.jit(rings.correct)(flat, heard)
    either = np.asarray(belief).sum(axis=0)
    assert np.flatnonzero(either > 0.1).tolist() == [7 + 48 * k for k in range(rings.RINGS)]
    assert float(evidence) == pytest.approx(-np.log(rings.PHASES), abs=1e-4)
    moved, by = jax.jit(rings.recentre)(ON[0], np.float32(3.2))
    assert float(by) == 3.0
    assert float(moved[0, rings.CELLS // 2 - 3]) == 1.0


def test_a_pattern_is_learnt_and_the_likeliest_phase_is_where_it_was_heard():
    rng, pitch = np.random.default_rng(0), jnp.float32(PITCH)
    relief = lambda place: 0.13 * (np.cos(2.0 * np.pi * place / PITCH) > 0.6)  # noqa: E731
    station = 0.17 * np.arange(153)
    along = np.stack([np.array([2.8, 1.16, 0.0, -1.16, -2.8])] * 2)
    height = relief(station[:, None, None] + along) + rng.normal(scale=0.04, size=(153, 2, 5))
    phases = pattern.waves(rings.TURNS)

    def step(learnt, seen):
        bumps = Bumps(seen[1], jnp.asarray(along, jnp.float32), jnp.ones((2, 5), bool))
        # What a robot says that believes to be 0.3 m short of where it is.
        behind = pattern.waves_at(seen[0] - 0.3, bumps, ONE, pitch)
        likely = pattern.log_likelihood(learnt, bumps, behind, phases, N_BEAMS)
        return pattern.learn(learnt, bumps, pattern.waves_at(seen[0], bumps, ONE, pitch), ONE), likely

    @jax.jit
    def learn():
        seen = jnp.asarray(station, jnp.float32), jnp.asarray(height, jnp.float32)
        learnt, likely = jax.lax.scan(step, pattern.empty_pattern(), seen)
        shape = pattern.heights(learnt, pattern.waves(jnp.zeros((2, 1))), phases)
        return pattern.strength(learnt, 5), shape[0, 0], likely, learnt

    strength, shape, likely, learnt = jax.tree.map(np.asarray, learn())
    assert strength > 0.9
    assert np.corrcoef(shape, relief(rings.TURNS * PITCH))[0, 1] > 0.9
    best = rings.TURNS[np.argmax(likely[-3:].sum(axis=0))] * PITCH
    assert np.mod(best - 0.3 + 0.675, PITCH) - 0.675 == pytest.approx(0.0, abs=0.06)
    np.testing.assert_array_equal(learnt.facing(-ONE).harmonics, learnt.harmonics[::-1])
