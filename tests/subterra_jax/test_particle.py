"""Particle filters on the map: how a cloud moves, is thinned and speaks, and what it is worth in the tasks."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines import cloud as particle_cloud
from subterra_jax.baselines import reckoning
from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.ceiling import ceiling
from subterra_jax.baselines.cloud import Cloud, CloudParams, OdometerNoise, new_cloud, weigh_odometer
from subterra_jax.baselines.particle import particle_filter
from subterra_jax.baselines.registry import make_agent
from subterra_jax.baselines.scanmodel import TunnelPose
from subterra_jax.baselines.wallmap import wall_map
from subterra_jax.evaluation import evaluate, listed_episodes
from subterra_jax.parts.slip import WanderParams
from tests.subterra_jax import tunnels

move, resample = jax.jit(particle_cloud.move), jax.jit(particle_cloud.resample)
summarise = jax.jit(particle_cloud.summarise)
EXACT = CloudParams(scale_sigma=0.0, wander=WanderParams(0.0), step_sigma=0.0)
PERIOD = jnp.float32(0.1)


def cloud_at(stations, weights=None, heading=0.0) -> Cloud:
    station = jnp.asarray(stations, jnp.float32)
    pose = TunnelPose(
        station, jnp.zeros_like(station), jnp.broadcast_to(jnp.asarray(heading, jnp.float32), station.shape)
    )
    cloud = new_cloud(jax.random.key(0), pose, EXACT)
    if weights is None:
        return cloud
    weight = jnp.asarray(weights, jnp.float32)
    return dataclasses.replace(cloud, log_weight=jnp.log(weight / jnp.sum(weight)))


def seen(distance: float, heading: float = 0.0) -> Observed:
    return Observed(jnp.zeros(18), jnp.zeros(16), jnp.float32(distance), jnp.float32(heading))


_reckon = jax.jit(reckoning.reckon)


def reckon(readings: list[float], speeds: list[float]):
    """Distances reckoned from what the odometer reads, and what is remembered at the end."""
    memory, distances = reckoning.begin_reckoning(seen(0.0)), []
    for reading, speed in zip(readings, speeds, strict=True):
        step, _, memory = _reckon(memory, seen(reading), jnp.float32(speed), 0.5, PERIOD)
        distances.append(float(step))
    return distances, memory


def test_command_and_odometer_share_a_step():
    distances, memory = reckon([0.0, 0.19, 0.40], [0.0, 2.0, 2.0])
    np.testing.assert_allclose(distances, [0.0, 0.195, 0.205], atol=1e-6)
    assert int(memory.delay) == 0


def test_a_frozen_odometer_leaves_the_command_alone():
    distances, _ = reckon([0.0, 0.2, 0.2, 0.22, 0.21], [0.0, 2.0, 2.0, 1.0, 1.0])
    np.testing.assert_allclose(distances, [0.0, 0.2, 0.2, 0.1, 0.1], atol=1e-6)


def test_an_odometer_that_is_frozen_from_the_start_is_not_waited_for():
    distances, memory = reckon([0.0] * 8, [0.0] + [2.0] * 7)
    np.testing.assert_allclose(distances, [0.0] * 5 + [0.2] * 3, atol=1e-6)
    assert sum(distances) + float(reckoning.unobserved_distance(memory, PERIOD)) == pytest.approx(7 * 0.2)


def test_the_age_of_what_is_observed_shows_when_the_robot_sets_off():
    distances, memory = reckon([0.0, 0.0, 0.0, 0.2, 0.4], [0.0, 2.0, 2.0, 2.0, 2.0])
    assert int(memory.delay) == 2
    np.testing.assert_allclose(distances, [0.0, 0.0, 0.0, 0.2, 0.2], atol=1e-6)
    assert float(reckoning.unobserved_distance(memory, PERIOD)) == pytest.approx(0.4)


def test_the_ceiling_knows_how_late_an_episode_is_by_its_severity():
    params = st.make("Subterra/Faulted-v1", tunnel="control")[1]
    before = reckoning.begin_reckoning(Observed(jnp.zeros(18), jnp.zeros(16), jnp.zeros(()), jnp.zeros(())))
    for severity, late in ((0, 0), (2, 1), (4, 2)):
        known = {"severity": severity, "fault_delay": 2.0 / float(params.faults.delay)}
        now = reckoning.known_delay(before, params, known)
        assert (int(now.delay), float(now.waiting)) == (late, 0.0)
    assert reckoning.known_delay(before, params, None) is before


def test_the_odometer_weighs_as_much_as_its_nominal_errors_allow():
    _, params = st.make("Subterra/StopAtShort-v1", tunnel="subterra-351")
    # Variances: odometer 0.02² + 0.01², plant 0.02² + 0.02².
    assert reckoning.odometer_fraction(params) == pytest.approx(8.0 / 13.0, rel=1e-5)


def test_a_cloud_that_faces_back_drives_to_smaller_stations(plan_of):
    straight = st.Tunnel.from_plan(plan_of(tunnels.tunnel_arrays(tunnels.straight(80.0))), "smooth")
    cloud = cloud_at([40.0], heading=np.pi)
    after = move(jax.random.key(1), cloud, wall_map(straight).pick(straight), jnp.float32(2.0), jnp.float32(0.0), EXACT)
    assert float(after.pose.station[0]) == pytest.approx(38.0, abs=1e-3)
    assert float(jnp.cos(summarise(after, EXACT)[2])) == pytest.approx(-1.0, abs=1e-3)


def test_resampling_draws_each_particle_as_often_as_its_weight_says():
    weights = np.full(200, 1e-6)
    weights[[10, 50, 120]] = [0.5, 0.3, 0.2]
    drawn = resample(jax.random.key(3), cloud_at(np.arange(200.0), weights), dataclasses.replace(EXACT, jitter=0.0))
    found = np.bincount(np.asarray(drawn.pose.station).astype(int), minlength=200)
    assert found[10] == pytest.approx(100, abs=1)
    assert found[50] == pytest.approx(60, abs=1)
    assert found[120] == pytest.approx(40, abs=1)
    np.testing.assert_allclose(drawn.log_weight, -np.log(200.0), rtol=1e-6)


def test_a_cloud_with_enough_particles_is_not_resampled():
    before = cloud_at(np.arange(100.0), np.linspace(1.0, 2.0, 100))
    after = resample(jax.random.key(3), before, EXACT)
    np.testing.assert_array_equal(before.pose.station, after.pose.station)
    np.testing.assert_array_equal(before.log_weight, after.log_weight)


def test_a_cloud_speaks_for_its_heaviest_cluster_and_admits_the_other():
    stations = np.concatenate([np.full(60, 10.0), np.full(40, 13.0)])
    station, sigma, _ = summarise(cloud_at(stations), EXACT)
    assert float(station) == pytest.approx(10.0)
    assert float(sigma) == pytest.approx(np.sqrt(0.4) * 3.0, rel=1e-3)


@pytest.fixture(scope="module")
def pockets():
    """The short stop between pockets, cut to 300 steps, and the filter's records of a few episodes."""
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="subterra-351", horizon=300)
    episodes = listed_episodes(env, params, 10)
    return env, params, episodes, evaluate(env, params, particle_filter(params, 64), episodes)


def test_the_filter_stops_at_the_goal_where_dead_reckoning_does_not(pockets):
    env, params, episodes, filtered = pockets
    blind = evaluate(env, params, make_agent("dead-reckoning", params), episodes)
    assert filtered.success.mean() >= 0.9
    assert blind.success.mean() <= 0.7
    assert np.median(filtered.axial_rms) < 0.05


def test_the_filter_knows_how_well_it_knows(pockets):
    assert 0.3 < np.median(pockets[3].nees) < 3.0


@pytest.mark.slow
def test_relocalisation_finds_place_and_direction():
    env, params = st.make("Subterra/Relocalise-v1", tunnel="subterra-351")
    found = evaluate(env, params, make_agent("particle-filter", params), listed_episodes(env, params, 20))
    assert found.success.mean() >= 0.7


def test_an_odometer_weighed_apart_learns_its_error_and_tells_ways_of_other_lengths_apart():
    noise = OdometerNoise(0.01, 0.02, WanderParams(0.0, 30.0), turn_sigma=0.02)
    motion = CloudParams(scale_sigma=0.0, wander=WanderParams(0.0, 30.0), odometer=noise)
    zero = jnp.zeros(2)
    cloud = new_cloud(jax.random.key(0), TunnelPose(zero, zero, zero), motion)
    cloud = dataclasses.replace(cloud, scale=jnp.asarray([0.0, 0.1]))
    step, read, ahead = jnp.asarray(0.2), jnp.asarray(0.2 * 1.02), jnp.zeros(())
    total = jnp.zeros(2)
    learn = jax.jit(weigh_odometer)
    for _ in range(400):
        cloud, likely = learn(cloud, step, read, ahead, motion)
        total += likely
    mean, variance = cloud.odometer.T
    # 400 readings of 5 % each: the mean of what they say and of 0 ± 2 %.
    information, prior = 400.0 / 0.05**2, 1.0 / 0.02**2
    assert float(mean[0]) == pytest.approx(0.02 * information / (information + prior), rel=0.01)
    assert float(variance[0]) == pytest.approx(1.0 / (information + prior), rel=0.01)
    assert float(total[0] - total[1]) > 5.0, "a way 10 % longer asks for an odometer four standard deviations off"
    stands, nothing = learn(cloud, step, jnp.zeros(()), jnp.asarray(jnp.nan), motion)
    np.testing.assert_array_equal(stands.odometer, cloud.odometer)
    assert not nothing.any()
    turned, _ = learn(cloud, jnp.zeros(()), jnp.zeros(()), jnp.asarray(1.5), motion)
    assert float(turned.odometer[0, 1]) == pytest.approx(float(variance[0]) + 0.02**2 * 1.5 / np.pi, rel=0.01)


def test_the_ceiling_takes_likelihoods_whole_about_a_start_and_drives_as_far_as_it_may_without_one():
    _, params = st.make("Subterra/StopAtShort-v1", tunnel="control")
    motion = ceiling(params).localiser.motion
    assert motion.odometer is not None
    assert motion.least_fraction < 0.1
    _, params = st.make("Subterra/Relocalise-v1", tunnel="control")
    made = ceiling(params)
    assert made.localiser.n_cells * made.localiser.cell >= float(params.tunnel.length)
    assert made.sure_for == float("inf")


def test_the_ceiling_spares_its_particles_where_the_start_is_hidden():
    cases = [(name, False) for name in ("StopAt", "Faulted", "Obstructed")] + [("StopAt", True), ("Faulted", True)]
    made = [
        ceiling(st.make(f"Subterra/{name}-v1", "control", hidden_start=hidden)[1]).localiser for name, hidden in cases
    ]
    assert [one.n_particles for one in made] == [512, 1024, 512, 1024, 2048]
    least = [one.motion.least_fraction for one in made]
    assert max(least[i] for i in (0, 1, 2, 4)) < 0.1
    assert least[3] > 0.3
