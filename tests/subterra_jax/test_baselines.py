"""The parts of the baselines, with known answers, and the tasks that they solve."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines import navigator, stations, steering
from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.registry import make_agent
from subterra_jax.baselines.stations import Station
from subterra_jax.baselines.steering import Avoidance
from subterra_jax.evaluation import evaluate, listed_episodes
from subterra_jax.parts.slip import WanderParams


@pytest.fixture(scope="module")
def params():
    return st.make("Subterra/Return-v1", tunnel="subterra-351")[1]


def between_walls(left: float, right: float, angle: float) -> np.ndarray:
    """Ranges between two straight, endless walls."""
    bearing = angle + np.arange(16) * np.pi / 8.0
    sine = np.sin(bearing)
    with np.errstate(divide="ignore"):
        ranges = np.where(sine > 1e-6, left / sine, np.where(sine < -1e-6, -right / sine, np.inf))
    return np.minimum(ranges, 30.0).astype(np.float32)


def observation(**fields) -> Observed:
    zero = jnp.zeros(())
    return Observed(**{"flat": jnp.zeros(21), "ranges": jnp.zeros(16), "distance": zero, "heading": zero, **fields})


def test_the_variance_of_a_wandering_error_is_its_double_integral():
    distance, wander = 70.0, WanderParams(sigma=0.02, length=30.0)
    u = (np.arange(1400) + 0.5) * distance / 1400
    numeric = 0.02**2 * np.exp(-np.abs(np.subtract.outer(u, u)) / 30.0).sum() * (distance / 1400) ** 2
    np.testing.assert_allclose(stations.wander_variance(jnp.float32(distance), wander), numeric, rtol=1e-4)


@pytest.mark.parametrize("angle", [0.0, 0.1, -0.1])
def test_the_first_look_finds_both_walls_and_the_angle_between_them(params, angle):
    look = jax.jit(steering.track_walls)
    ranges = jnp.asarray(between_walls(2.5, 3.1, angle))
    found = jax.jit(steering.find_walls)(ranges, params)
    for _ in range(20):
        found = look(found, ranges, params)
    np.testing.assert_allclose([found.left, found.right, found.angle], [2.5, 3.1, angle], atol=2e-3)
    np.testing.assert_allclose(found.offset, 0.3, atol=2e-3)


def test_beams_without_echo_and_beams_in_dust_do_not_move_the_walls(params):
    look = jax.jit(steering.track_walls)
    clean = between_walls(2.8, 2.8, 0.0)
    found = jax.jit(steering.find_walls)(jnp.asarray(clean), params)
    for i in range(30):
        corrupted = clean.copy()
        corrupted[(np.arange(6) + i) % 16] = 30.0
        corrupted[(i * 5) % 16] *= 0.3
        found = look(found, jnp.asarray(corrupted), params)
        assert abs(found.offset) < 0.1
        assert abs(found.angle) < 0.05


def test_a_command_moves_the_walls_as_it_moves_the_robot(params):
    before = steering.Corridor(jnp.float32(2.0), jnp.float32(3.0), jnp.float32(np.pi / 2))
    after = steering.predict_walls(before, jnp.array([2.0, 0.0]), params)
    np.testing.assert_allclose([after.left, after.right], [1.8, 3.2], atol=1e-6)
    back = steering.mirror_walls(before)
    np.testing.assert_allclose([back.left, back.right, back.angle], [3.0, 2.0, -np.pi / 2], atol=1e-6)


def test_the_last_period_before_the_goal_just_reaches_it(params):
    obs = observation(goal=jnp.float32(40.0), ring_pitch=jnp.zeros(()))
    start, speed = navigator.start_mission(obs), []
    for station in (30.0, 39.9, 40.5):
        estimate = Station(jnp.float32(station), jnp.zeros(()), jnp.ones(()))
        speed.append(float(navigator.target_speed(start, estimate, obs, params.replace(goal_kind="stop"))))
    np.testing.assert_allclose(speed, [2.0, 1.0, 0.0], atol=1e-4)
    there = navigator.check_arrival(start, jnp.float32(1.0), jnp.float32(1.0), params)
    assert there.stopped
    # Slowed down by something else, it has not arrived.
    assert not navigator.check_arrival(start, jnp.float32(1.0), jnp.float32(0.5), params).stopped


def test_it_turns_by_half_a_turn_once_the_flag_is_up_and_never_stands_for_it(params):
    heading, flag = 3.0, 0.0
    now = navigator.start_mission(observation(heading=jnp.float32(heading), flag=jnp.zeros(()), goal=jnp.float32(9.0)))
    turned = 0.0
    for step in range(60):
        flag = 1.0 if step >= 5 else 0.0
        wrapped = (heading + np.pi) % (2 * np.pi) - np.pi
        obs = observation(heading=jnp.float32(wrapped), flag=jnp.float32(flag), goal=jnp.float32(9.0))
        now, raised, _ = navigator.watch(now, obs, params.replace(goal_kind="return"))
        assert bool(raised) == (step == 5)
        if navigator.is_turning(now):
            speed, rate = np.asarray(navigator.turn_command(now, params))
            assert speed > params.goal.still_speed
            heading, turned = heading + 0.1 * rate, turned + 0.1 * rate
    assert now.direction == -1.0
    assert abs(turned - np.pi) < 0.1


def test_a_box_in_the_way_slows_it_down_and_has_it_choose_another_lane(params):
    ranges = between_walls(2.8, 2.8, 0.0)
    ranges[0] = 2.0
    avoid = Avoidance()
    clear = observation(ranges=jnp.asarray(between_walls(2.8, 2.8, 0.0)))
    memory, look = avoid.begin(clear, params), jax.jit(avoid.look)
    free = look(memory, clear, jnp.zeros(2), params)
    assert abs(free.lane) < 0.05
    blocked = look(memory, observation(ranges=jnp.asarray(ranges)), jnp.zeros(2), params)
    assert abs(blocked.lane) >= params.vehicle.radius + avoid.margin
    for far, leaves in ((3.7, False), (3.25, True)):  # m; a metre of free way is worth about one aside
        ranges[0] = far
        assert (abs(look(memory, observation(ranges=jnp.asarray(ranges)), jnp.zeros(2), params).lane) > 0.1) == leaves
    back, was = avoid.turn_round(blocked), blocked
    told = jnp.stack([back.along + was.along, back.across + was.across])
    assert (jnp.nan_to_num(told) == 0.0).all()
    assert (back.lane, back.corridor.left) == (-was.lane, was.corridor.right)
    steer = jax.jit(avoid.steer)
    assert steer(free, jnp.float32(2.0), params)[0] == pytest.approx(avoid.speed)
    near = dataclasses.replace(blocked, along=blocked.along - 1.3, lane=jnp.zeros(()))
    assert 0.05 < steer(near, jnp.float32(2.0), params)[0] < 0.3


def test_where_a_corner_is_near_it_turns_steeper_to_its_lane_than_where_the_way_is_free(params):
    avoid = Avoidance()
    clear = observation(ranges=jnp.asarray(between_walls(2.8, 2.8, 0.0)))
    memory = dataclasses.replace(avoid.begin(clear, params), lane=jnp.float32(-1.0))
    plain = -avoid.offset_gain
    heading = jax.jit(avoid.heading)
    assert heading(memory, params) == pytest.approx(plain, abs=0.05)
    # 0.7 m on, in the way at the plain angle; across the tunnel there is room.
    near = (0.7 * np.cos(plain), 0.7 * np.sin(plain))
    corner = dataclasses.replace(
        memory, along=memory.along.at[0, 0].set(near[0]), across=memory.across.at[0, 0].set(near[1])
    )
    steeper = heading(corner, params)
    assert -1.5 <= steeper < plain - 0.1
    assert avoid.room(corner, steeper, params) > avoid.headway + 0.2 > avoid.room(corner, jnp.float32(plain), params)
    there = dataclasses.replace(corner, lane=jnp.zeros(()))
    assert abs(heading(there, params)) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "least"), [("Return", 1.0), ("Obstructed", 0.97), ("Faulted", 0.99), ("Relocalise", 1.0)]
)
def test_over_the_whole_list_knowing_the_truth_is_all_that_is_missing(task, least):
    env, params = st.make(f"Subterra/{task}-v1", tunnel="subterra-351")
    records = evaluate(env, params, make_agent("oracle", params), listed_episodes(env, params))
    assert records.success.mean() >= least


@pytest.mark.slow
def test_dead_reckoning_knows_how_well_it_knows():
    env, params = st.make("Subterra/StopAt-v1", tunnel="subterra-351")
    for name in ("dead-reckoning", "fused"):
        records = evaluate(env, params, make_agent(name, params), listed_episodes(env, params))
        assert 0.85 < records.nees.mean() < 1.15, name
