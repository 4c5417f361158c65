"""Drawn geometry of a moment, against geometry that is known."""

import numpy as np
import pytest

from subterra_jax.recorder.trace import reckon
from subterra_jax.viewer.geometry import Centreline, EpisodeGeometry, planar_shapes
from subterra_jax.viewer.panel import error_series, progress_series
from subterra_jax.viewer.player import Player
from tests.subterra_jax import tunnels
from tests.subterra_jax.viewer.episodes import straight


@pytest.fixture(scope="module")
def centreline(plan_of):
    return Centreline(plan_of(tunnels.tunnel_arrays(tunnels.straight(60.0))))


@pytest.fixture(scope="module")
def episode(centreline):
    return EpisodeGeometry(straight(), centreline)


def test_the_robot_is_half_way_between_two_rows_at_half_a_row(episode):
    moment = episode.moment(2.5)
    np.testing.assert_allclose(moment.position, [0.5, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(moment.odometry, [0.55, 0.0, 0.0], atol=1e-6)
    assert (moment.row, episode.moment(-3.0).row, episode.moment(1e9).row) == (2, 0, 20)


def test_a_turn_through_south_is_not_shown_the_long_way_round(centreline):
    heading = np.array([3.1, -3.1], np.float32)
    moment = EpisodeGeometry(straight(2, heading=heading), centreline).moment(0.5)
    assert abs(np.cos(moment.heading) + 1.0) < 1e-3


def test_beams_end_where_they_measured(episode):
    beams, hit = episode.beams(10)  # in the robot's frame
    np.testing.assert_allclose(beams[:, 0], [[0.0, 0.0, 0.6]] * 4, atol=1e-6)
    np.testing.assert_allclose(beams[:, 1], [[30, 0, 0.6], [0, 2, 0.6], [-3, 0, 0.6], [0, -4, 0.6]], atol=1e-5)
    assert hit.tolist() == [False, True, True, True]


def test_what_hangs_on_the_robot_is_given_in_its_frame(centreline):
    turned = EpisodeGeometry(straight(heading=np.full(21, np.pi / 2, np.float32)), centreline)
    there = np.array([[[2.0, 5.0, 0.3]]])  # the robot stands at (2, 0) and looks to +y
    np.testing.assert_allclose(turned.carried(10, there), [[[5.0, 0.0, 0.3]]], atol=1e-6)


def test_odometry_that_turns_too_much_drives_a_circle():
    turn = np.linspace(0.0, np.pi, 2001)
    odometry = np.stack([5.0 * turn, turn], axis=-1)
    way, _ = reckon(odometry, np.array([1.0, 2.0]))
    np.testing.assert_allclose(way[-1], [1.0, 12.0], atol=1e-4)
    np.testing.assert_allclose(np.hypot(*(way - [1.0, 7.0]).T), 5.0, atol=1e-4)


def test_exact_odometry_lies_on_the_true_way(centreline):
    episode = straight()
    episode = EpisodeGeometry(straight(odometry=np.stack([episode.station, episode.heading], axis=-1)), centreline)
    for at in (0.0, 7.3, 20.0):
        np.testing.assert_allclose(episode.moment(at).odometry, episode.moment(at).position, atol=1e-6)


def test_the_ellipse_reaches_two_standard_deviations_along_the_axis(episode):
    points = episode.ellipse(10).reshape(-1, 3)
    np.testing.assert_allclose([points[:, 0].min(), points[:, 0].max()], [2.0, 4.0], atol=0.01)
    assert episode.ellipse(0).shape == (0, 2, 3)


def test_the_ellipse_is_as_wide_as_the_particles(centreline):
    cloud = np.zeros((21, 2, 3), np.float32)
    cloud[:, :, 1], cloud[:, :, 2] = [0.5, 1.5], 1.0
    points = EpisodeGeometry(straight(cloud=cloud), centreline).ellipse(10).reshape(-1, 3)
    np.testing.assert_allclose([points[:, 1].min(), points[:, 1].max()], [0.0, 2.0], atol=0.01)


def test_the_ellipse_follows_a_bend(plan_of):
    bend = Centreline(plan_of(tunnels.tunnel_arrays(tunnels.arc(60.0, 40.0))))
    estimate = np.tile(np.array([30.0, 10.0], np.float32), (21, 1))
    points = EpisodeGeometry(straight(estimate=estimate), bend).ellipse(5).reshape(-1, 3)
    away = np.sqrt(((points[:, None, :2] - bend.plan.centre) ** 2).sum(-1)).min(axis=1)
    assert away.max() < 0.5


def test_the_gate_stands_at_the_goal_and_is_as_wide_as_the_tunnel(episode, centreline):
    gate = episode.goal().reshape(-1, 3)
    np.testing.assert_allclose(gate[:, 0], 40.0, atol=1e-6)
    np.testing.assert_allclose(np.ptp(gate[:, 1]), 2 * 2.825 - 0.1, atol=1e-6)
    assert len(EpisodeGeometry(straight(goal=np.nan), centreline).goal()) == 0


def test_trails_end_at_the_robot_and_at_the_odometer(episode):
    truth, odometry = episode.trails(episode.moment(10.5))
    np.testing.assert_allclose(truth[-1, 1, :2], [2.1, 0.0], atol=1e-6)
    np.testing.assert_allclose(odometry[-1, 1, :2], [2.31, 0.0], atol=1e-6)


def test_charts_hold_coverage_reward_and_errors(episode):
    time, coverage, reward = progress_series(episode)
    assert (time[-1], round(float(coverage[-1]), 4), reward[-1]) == (2.0, round(100 * 4.0 / 60.0, 4), 10.5)
    _, odometer, error, low, high = error_series(episode)
    np.testing.assert_allclose([odometer[-1], error[-1], low[-1], high[-1]], [0.4, 1.0, 0.0, 2.0], atol=1e-5)


def test_walls_and_floor_of_a_plan_are_seen_from_within(centreline):
    for shape in planar_shapes(centreline.plan, "smooth"):
        corners = shape.vertices[shape.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        inside = np.array([30.0, 0.0, 1.3]) - corners.mean(axis=1)
        inside[:, 0] = 0.0
        assert (np.sum(normal * inside, axis=1) > 0.0).all(), shape.name


def test_walls_stand_where_the_lining_has_them(centreline):
    left, right, floor = planar_shapes(centreline.plan, "pockets")
    np.testing.assert_allclose(left.vertices[:, 1].min(), 2.825, atol=1e-6)
    np.testing.assert_allclose(left.vertices[:, 1].max(), 2.825 + tunnels.POCKET_DEPTH, atol=1e-6)
    assert right.vertices[:, 1].max() < 0.0 < left.vertices[:, 2].max()
    assert not floor.vertices[:, 2].any()


def test_the_clock_plays_pauses_seeks_and_stops_at_the_end(episode):
    player = Player(lambda *moment: None)
    assert player.advance(1.0) is None
    player.begin(episode, playing=True)
    player.speed = 2.0
    assert player.advance(0.5)[1].row == 10
    player.toggle()
    assert player.advance(1.0)[2]
    assert (player.advance(1.0), round(player.time, 6)) == (None, 1.0)
    player.seek(0.3)
    assert (player.advance(1.0)[1].row, player.playing) == (3, False)
    player.toggle()
    assert player.advance(100.0)[2]
    assert (player.playing, player.time) == (False, 2.0)
    player.toggle()
    assert (player.playing, player.time) == (True, 0.0)


def test_the_clock_waits_for_an_episode_that_is_still_being_driven(centreline):
    player = Player(lambda *moment: None)
    player.begin(EpisodeGeometry(straight(5), centreline, finished=False), playing=True)
    assert player.advance(100.0)[1].row == 4
    assert player.playing
    player.grow(EpisodeGeometry(straight(9), centreline))
    assert player.advance(0.2)[1].row == 6


def test_furniture_stands_on_the_ground_where_it_is(plan_of):
    arrays = tunnels.tunnel_arrays(tunnels.straight(60.0))
    arrays["elevation"] = 0.1 * arrays["station"]
    arrays["furniture_smooth"] = np.array([[30.0, 2.0, 30.0, 2.4], [45.0, -2.0, 45.2, -2.0]])
    *_, furniture = planar_shapes(plan_of(arrays), "smooth")
    np.testing.assert_allclose(
        furniture.vertices[:4], [[30, 2, 3], [30, 2.4, 3], [45, -2, 4.5], [45.2, -2, 4.5]], atol=1e-6
    )
    assert len(furniture.faces) == 8
