"""The belief over a map, on tunnels where the answer is known beforehand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import policies
from subterra_jax.baselines.agent import observed
from subterra_jax.policies import belief_grid as grid
from subterra_jax.policies.belief import Belief, Habits
from subterra_jax.policies.belief_scan import N_FEATURES
from tests.subterra_jax import tunnels

TASK = "Subterra/Relocalise-v1"
LENGTH, POCKET = 70.0, 40.0
CELL, N = 0.1, 512
TAPE = jnp.asarray(grid.cell_positions(N, CELL))
summarise, turn_round, spread = (jax.jit(f) for f in (grid.summarise, grid.turn_round, grid.spread))


def one_pocket(plan_of):
    """A straight smooth tunnel with one recess, 60 cm long, in its left wall."""
    arrays = tunnels.tunnel_arrays(tunnels.straight(LENGTH), half_width=2.8)
    station = np.array([0.0, POCKET, POCKET, POCKET + 0.6, POCKET + 0.6, LENGTH])
    offset = np.array([2.8, 2.8, 3.1, 3.1, 2.8, 2.8])
    arrays["left_smooth"], arrays["left_station_smooth"] = np.stack([station, offset], axis=1), station
    return plan_of(arrays)


def untrained() -> Belief:
    """The nominal likelihood alone."""
    layers = {f"scan.hidden_{i}.kernel": jnp.zeros(shape) for i, shape in enumerate(((N_FEATURES, 4), (4, 1)))}
    layers |= {f"scan.hidden_{i}.bias": jnp.zeros(n) for i, n in enumerate((4, 1))}
    low, high = jnp.array([0.0, -1.5]), jnp.array([2.0, 1.5])
    return Belief({**layers, "temper": jnp.zeros(()), "nominal": jnp.float32(-0.7)}, low, high)


@pytest.fixture(scope="module")
def world(plan_of):
    return st.make(TASK, tunnel=one_pocket(plan_of), lining="smooth")


@pytest.fixture(scope="module")
def agent(world):
    return untrained().with_map(world[1])


@pytest.fixture(scope="module")
def drive(world):
    env, params = world

    @jax.jit
    def drive(agent, share, way):
        """Station and direction facing, true and believed, while an agent drives for 6 s from a start of choice."""
        key = jax.random.key(3)
        drawn = env.draw_reset(key, (), params)
        spread, _, offset = drawn["rule"]
        state = env.begin({**drawn, "rule": (spread, jnp.stack([jnp.zeros(()), share, way]), offset)}, params)
        noise = env.draw_step(key, (), params)
        memory = agent.begin(key, observed(env, params, env.observe(state, noise, params)), params)

        def step(carry, t):
            state, noise, memory = carry
            obs = observed(env, params, env.observe(state, noise, params))
            action, memory = agent.act(key, memory, obs, params, None)
            noise = env.draw_step(jax.random.fold_in(key, t), (), params)
            state, *_, info = env.advance(state, action, noise, params)
            return (state, noise, memory), (info["station"], action, memory.log_mass)

        return jax.lax.scan(step, (state, noise, memory), jnp.arange(1, 61))[1]

    return drive


@pytest.fixture(scope="module")
def driven(drive, agent):
    """From 35 m on towards growing stations, and from 45 m on towards falling ones."""
    return [
        jax.device_get(drive(agent, (start - 5.0) / (LENGTH - 10.0), way)) for start, way in ((35.0, 1.0), (45.0, 0.0))
    ]


@pytest.mark.parametrize("case", [0, 1])
def test_one_pocket_gives_place_and_direction_away_at_once(driven, case):
    station, action, log_mass = driven[case]
    assert abs(action[-1, 2] - station[-1]) < 0.3
    assert action[-1, 4] == (1.0, -1.0)[case]
    assert action[-1, 3] < np.log(0.5)
    # Before it came to the pocket it could have been almost anywhere.
    assert action[1, 3] > np.log(10.0)
    np.testing.assert_allclose(np.exp(log_mass).sum(axis=(1, 2)), 1.0, atol=1e-4)


def test_a_released_policy_believes_the_same_to_the_last_bit(drive, agent, driven, world):
    layout = {"action_low": [0.0, -1.5], "action_high": [2.0, 1.5], "habits": dataclasses.asdict(Habits())}
    tensors = {name: np.asarray(tensor) for name, tensor in agent.tensors.items()}
    again = policies.from_tensors("belief", layout, tensors, agent.name)
    policies.check_fits(again, *world, "again")
    assert again.map is None
    found = drive(policies.with_map(again, world[1]), 0.5, 1.0)
    np.testing.assert_array_equal(found[2][-1], driven[0][2][-1])


def test_without_a_map_it_refuses_to_begin(world):
    env, params = world
    obs = observed(env, params, jnp.zeros(env.observation_size(params)))
    with pytest.raises(policies.PolicyError, match="has no map yet"):
        untrained().begin(jax.random.key(0), obs, params)


def test_other_tasks_refuse_it():
    with pytest.raises(policies.PolicyError, match="which Subterra/StopAt-v1 does not ask for"):
        policies.check_fits(untrained(), *st.make("Subterra/StopAt-v1"), "mine")


def at(way: int, place: float) -> jax.Array:
    """A belief that is sure of one tape position."""
    return jnp.full((2, N), -40.0).at[way, int(place / CELL)].set(0.0)


@pytest.mark.parametrize(("way", "station"), [(0, 22.05), (1, 50.0 - 22.05)])
def test_driving_on_leads_each_tape_its_own_way(way, station):
    told = summarise(at(way, 12.05), grid.stations(TAPE, jnp.float32(10.0), jnp.float32(50.0)), jnp.float32(0.8), CELL)
    assert float(told.station) == pytest.approx(station, abs=1e-3)
    assert float(told.direction) == (1.0, -1.0)[way]
    assert float(told.mass) == pytest.approx(1.0)


@pytest.mark.parametrize("way", [0, 1])
def test_turning_round_changes_the_direction_and_not_the_place(way):
    length, driven = jnp.float32(50.0), jnp.float32(10.03)
    before = summarise(at(way, 12.05), grid.stations(TAPE, driven, length), jnp.float32(0.8), CELL)
    turned = turn_round(at(way, 12.05), driven, length, CELL)
    after = summarise(turned, grid.stations(TAPE, jnp.float32(0.0), length), jnp.float32(0.8), CELL)
    assert float(after.station) == pytest.approx(float(before.station), abs=1e-3)
    assert float(after.direction) == -float(before.direction)
    assert float(jnp.sum(jnp.exp(turned))) == pytest.approx(1.0, abs=1e-5)


def test_dead_reckoning_spreads_the_belief_by_its_variance_and_a_leak_reaches_every_cell():
    belief = at(0, 25.05)
    for _ in range(50):
        belief = spread(belief, jnp.float32(0.2), jnp.float32(0.0))
    mass = np.exp(belief[0])
    middle = np.sum(mass * TAPE)
    assert middle == pytest.approx(25.05, abs=1e-3)
    assert np.sum(mass * (TAPE - middle) ** 2) == pytest.approx(50 * 0.2 * CELL**2, rel=0.01)
    leaked = np.exp(spread(at(0, 25.05), jnp.float32(0.0), jnp.float32(0.1)))
    assert leaked.min() == pytest.approx(0.1 / (2 * N), rel=1e-3)
    assert leaked.sum() == pytest.approx(1.0, abs=1e-5)


def test_a_start_anywhere_is_as_likely_everywhere_but_at_the_ends():
    mass = np.exp(grid.uniform_log_mass(TAPE, jnp.float32(50.0), jnp.float32(5.0)))
    inside = (np.asarray(TAPE) > 5.0) & (np.asarray(TAPE) < 45.0)
    np.testing.assert_allclose(mass[:, inside], 1.0 / (2 * inside.sum()), rtol=1e-3)
    assert mass[:, ~inside].max() < 1e-9
