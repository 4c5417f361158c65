"""The histogram filter: how its belief slides, and that it finds its place where the answer is known beforehand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines import histogram
from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.cloud import CloudParams
from subterra_jax.baselines.histogram import HistogramLocaliser
from subterra_jax.evaluation import evaluate, listed_episodes
from subterra_jax.policies import open_agent
from tests.subterra_jax import tunnels

CELL, START = 0.1, 30.0


@pytest.fixture(scope="module")
def smooth(plan_of):
    """A straight tunnel without relief: the walls tell nothing of the station."""
    arrays = tunnels.tunnel_arrays(tunnels.straight(150.0), half_width=2.8)
    return st.make("Subterra/StopAt-v1", tunnel=plan_of(arrays), lining="smooth", estimates=True)


def localiser(params) -> HistogramLocaliser:
    return HistogramLocaliser.of(params, cell=CELL)


def seen(distance: float = 0.0, heading: float = 0.0) -> Observed:
    obs = Observed(jnp.zeros(18), jnp.full(16, 30.0), jnp.float32(distance), jnp.float32(heading))
    return dataclasses.replace(obs, start=jnp.float32(START))


def certain(filter_):
    """Return a filter whose heading does not wander and whose steps do not slip."""
    wander = dataclasses.replace(filter_.noise.wander, sigma=0.0)
    return dataclasses.replace(filter_, noise=CloudParams(0.015, wander, 0.0))


def test_a_row_of_errors_slides_by_its_share_of_the_way_and_back_again(smooth):
    _, params = smooth
    filter_ = localiser(params)
    still = certain(filter_)
    memory = jax.jit(still.begin)(seen(), params)
    mass = jnp.exp(memory.log_mass)
    slide = jax.jit(still._slide)
    tape = np.asarray(jax.jit(still._tape)(memory.origin))

    def middle(rows):
        weight = np.asarray(rows[0, -1], np.float64)
        return (weight * tape).sum() / weight.sum()

    before = middle(mass)
    for _ in range(50):
        mass = slide(mass, jnp.float32(0.2))
    assert middle(mass) - before == pytest.approx(histogram.MOST_SCALE * 10.0, abs=0.02)
    for _ in range(50):
        mass = slide(mass, jnp.float32(-0.2))
    assert middle(mass) - before == pytest.approx(0.0, abs=0.02)
    assert float(mass.sum()) == pytest.approx(1.0, abs=1e-3)


def test_it_stops_within_centimetres_where_dead_reckoning_misses():
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="subterra-351", estimates=True)
    episodes = listed_episodes(env, params, 2)
    coarse = dataclasses.replace(
        open_agent(histogram.NAME, env, params), localiser=HistogramLocaliser.of(params, cell=CELL)
    )
    records = evaluate(env, params, coarse, episodes)
    assert records.success.all()
    assert np.abs(records.goal_error).max() < 0.15


@pytest.mark.slow
def test_it_finds_out_where_it_is():
    env, params = st.make("Subterra/Relocalise-v1", tunnel="subterra-351", estimates=True)
    records = evaluate(env, params, open_agent(histogram.NAME, env, params), listed_episodes(env, params, 4), 4)
    assert records.success.all()
