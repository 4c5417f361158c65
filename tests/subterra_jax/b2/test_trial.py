"""What is made of many robots' walks."""

from types import SimpleNamespace

import numpy as np
import pytest

import subterra_jax as st
from benchmarks import b2_traverse
from subterra_jax.b2 import transfer
from subterra_jax.evaluation import listed_episodes
from tests.subterra_jax import probes

PARAMS = SimpleNamespace(vehicle=SimpleNamespace(period=0.2), tunnel=SimpleNamespace(length=np.array(100.0)))


def test_figures_of_four_robots_are_what_one_counts_by_hand():
    """Two arrive after 80 m in 100 s, one falls after 20 m in 50 s, one touches the wall where it stood."""
    state = SimpleNamespace(
        station=np.array([82.0, 82.0, 22.0, 2.0]),
        furthest=np.array([90.0, 90.0, 30.0, 10.0]),
        odometry=SimpleNamespace(distance=np.array([84.0, 76.0, 20.0, 0.0])),
        steps=np.array([500, 500, 250, 1]),
        tunnel=np.zeros(4, int),
    )
    walk = transfer.Walk(
        state=state,
        over=np.ones(4, bool),
        success=np.array([True, True, False, False]),
        contact=np.array([False, False, False, True]),
        fall=np.array([False, False, True, False]),
        begun=np.full(4, 2.0),
    )
    rows = transfer.Row(
        lateral=np.array([[0.3, -0.4, np.nan, np.nan]]),
        command=np.array([[[1.0, 0.2], [1.0, 0.0], [np.nan] * 2, [np.nan] * 2]]),
        motion=np.array([[[0.8, 0.1], [0.6, 0.0], [np.nan] * 2, [np.nan] * 2]]),
        lean=np.array([[[0.1, 0.0], [-0.1, 0.0], [np.nan] * 2, [np.nan] * 2]]),
        sway=np.array([[[0.3], [-0.4], [np.nan], [np.nan]]]),
    )
    told = transfer.figures(walk, rows, PARAMS)
    assert told["robots"] == 4
    assert (told["success_percent"], told["fall_percent"], told["contact_percent"]) == (50.0, 25.0, 25.0)
    assert told["coverage_median_percent"] == pytest.approx(60.0)
    assert told["speed_mean"] == pytest.approx((0.8 + 0.8 + 0.4 + 0.0) / 4)
    assert told["lateral_rms"] == told["range_off_rms"] == pytest.approx(np.sqrt(0.125))
    assert told["odometer_error_percent"] == pytest.approx(0.0)
    assert told["odometer_error_sigma_percent"] == pytest.approx(100.0 * np.sqrt(2 * 0.05**2 / 4))
    assert (told["speed_obeyed_percent"], told["yaw_obeyed_percent"]) == pytest.approx((70.0, 50.0))
    assert told["pitch_sigma_deg"] == pytest.approx(np.rad2deg(0.1))


@pytest.mark.parametrize("name", ["nothing", "truth"])
def test_a_robot_is_driven_by_what_its_agent_declares_and_no_more(name):
    agent, speed = probes.PROBES[name]
    env, params = st.make("Subterra/TraverseShort-v1", horizon=3)
    walk, rows = transfer.walk_robots(env, params, agent, listed_episodes(env, params, 2))
    np.testing.assert_allclose(walk.state.command[:, 0], speed, rtol=1e-4)
    assert np.nanstd(rows.sway) == pytest.approx(0.05, rel=0.5)  # the noise of the LiDAR


def test_the_figures_are_records_with_intervals_after_wilson():
    asked = b2_traverse.Command(robot="rover", robots=100, agent="out/mine", task="StopAt-v1")
    records = {r.id: r for r in b2_traverse.records_of(asked, {"success_percent": 50.0, "speed_mean": 0.5})}
    success = records["b2/rover/StopAt-v1/mjx/mine/success"]
    assert (success.interval, success.n) == ((40.4, 59.6), 100)
    assert "--robot rover --task StopAt-v1 --agent out/mine" in success.command
    assert records["b2/rover/StopAt-v1/mjx/mine/speed-mean"].unit == "m/s"
