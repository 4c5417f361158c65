"""Nobody knows what he has not measured: the leak tests of the task design."""

import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.baselines.registry import make_agent, names
from subterra_jax.evaluation import evaluate, listed_episodes
from subterra_jax.evaluation.floor import floor, within
from tests.subterra_jax.panel import panel

N = 200
BLIND = ("random",)
STOPPING = ("dead-reckoning", "fused", "oracle")


def odometry_bound(params) -> float:
    """Success of a stop by the odometer alone, in closed form: bias, wandering error and noise of each step."""
    goal, odometry = params.goal, params.odometry
    furthest = min(float(goal.high), float(params.tunnel.length) - 2.0 * float(goal.margin))
    distance = np.linspace(float(goal.low), furthest, 200)
    sigma, length = float(odometry.wander.sigma), float(odometry.wander.length)
    wandered = 2.0 * sigma**2 * length * (distance + length * np.expm1(-distance / length))
    noise = float(odometry.distance_sigma) ** 2 / float(params.vehicle.speed_max * params.vehicle.period) * distance
    variance = (float(odometry.distance_bias_sigma) * distance) ** 2 + wandered + noise
    return within(float(goal.tolerance), np.sqrt(variance))


def three_errors(bound: float, n: int = N) -> float:
    """Three standard errors of a success rate of n episodes."""
    return 3.0 * np.sqrt(bound * (1.0 - bound) / n)


@pytest.fixture(scope="module")
def control():
    """The short stop where no wall tells a station, a way to drive it, and its bounds."""
    env, params = st.make("Subterra/StopAtShort-v1", tunnel="control")
    agents = [make_agent(name, params) for name in STOPPING + BLIND]
    episodes = listed_episodes(env, params, N)

    def success(name, **corrupted):
        return evaluate(
            env, params, panel(agents, (STOPPING + BLIND).index(name), **corrupted), episodes
        ).success.mean()

    return success, {"odometry": odometry_bound(params), "fused": floor(params)}


def test_fusing_both_stops_as_often_as_theory_says_and_no_more(control):
    success, bounds = control
    assert abs(success("fused") - bounds["fused"]) < three_errors(bounds["fused"])


@pytest.mark.parametrize("name", BLIND)
def test_nobody_without_lidar_is_above_the_fused_bound(control, name):
    success, bounds = control
    assert success(name) < bounds["fused"] + three_errors(bounds["fused"])


def test_the_truth_stops_always_so_that_the_bounds_are_those_of_knowing_not_of_driving(control):
    success, _ = control
    assert success("oracle") == 1.0


def test_who_is_always_told_the_same_goal_stops_as_often_as_chance_has_it(control):
    success, _ = control
    # Goals lie anywhere in 50 m and more, and a stop counts within 0.25 m on either side.
    chance = 0.5 / 50.0
    assert success("oracle", goal=175.0) < chance + three_errors(chance)


def test_who_gets_the_beams_in_the_wrong_order_cannot_traverse():
    env, params = st.make("Subterra/TraverseShort-v1")
    agents, episodes = [make_agent("dead-reckoning", params)], listed_episodes(env, params, 50)
    order = np.random.default_rng(0).permutation(16)
    assert evaluate(env, params, panel(agents), episodes).success.all()
    assert evaluate(env, params, panel(agents, order=order), episodes).success.mean() < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(names()) - {"oracle"}))
def test_on_the_control_tunnel_nobody_beats_fused_dead_reckoning_by_three_points(name):
    env, params = st.make("Subterra/StopAt-v1", tunnel="control", lining="smooth")
    bound = floor(params)
    agent = make_agent(name, params)
    success = evaluate(env, params, agent, listed_episodes(env, params)).success.mean()
    print(f"{name}: {100 * success:.1f} %, bound {100 * bound:.1f} %")
    # Three points, and the error of 500 episodes.
    assert success <= bound + 0.03 + three_errors(bound, 500)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "bound"), [("dead-reckoning", odometry_bound), ("fused", floor)])
def test_over_the_whole_list_dead_reckoning_lands_at_its_bounds(name, bound):
    env, params = st.make("Subterra/StopAt-v1", tunnel="subterra-351")
    expected = bound(params)
    success = evaluate(env, params, make_agent(name, params), listed_episodes(env, params)).success.mean()
    print(f"{name}: {100 * success:.1f} %, bound {100 * expected:.1f} %")
    assert abs(success - expected) < three_errors(expected, 500)


@pytest.mark.slow
def test_over_the_whole_list_the_middle_line_traverses_always():
    env, params = st.make("Subterra/Traverse-v1")
    records = evaluate(env, params, make_agent("dead-reckoning", params), listed_episodes(env, params))
    assert records.success.all()
