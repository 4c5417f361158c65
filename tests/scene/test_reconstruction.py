"""Reconstruction of known bores; the contract between cleaning, fitting and judging; what hangs is no wall."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from shapely import LineString, points

from scene.bore import Bore
from scene.cleaning.sort import list_removed, sort_points
from scene.cleaning.tube import Tube, bridge_hanging
from scene.cloud import Cloud
from scene.errors import Cause
from scene.fitting.axis import section_middles
from scene.fitting.section import visible_span
from scene.fitting.unroll import Grid
from scene.geometry import Around, axis_through
from tests.scene.clouds import KnownBore, curved_d_bore
from tests.scene.fits import cleaned, keep, rebuilt, thin
from tests.scene.shapes import PLACE, midline, outline, swept

STRAIGHT = np.array([[0.0] * 3, [30.0, 0.0, 0.0]])


def offsets(bore: Bore, cloud: Cloud, known: KnownBore) -> tuple[np.ndarray, np.ndarray]:
    centre = known.centre - cloud.origin
    offset = bore.position - centre[cKDTree(centre).query(bore.position)[1]]
    return np.einsum("ij,ij->i", offset, bore.lateral), np.einsum("ij,ij->i", offset, bore.up)


@pytest.mark.parametrize("yaw", [0.0, 2.3])
def test_a_curved_d_bore_is_measured_in_any_orientation(yaw):
    known = curved_d_bore(yaw=yaw, per_metre=2000)
    bore, cloud = rebuilt(known.points)
    keep(bore)
    lateral, vertical = offsets(bore, cloud, known)
    assert np.sqrt(np.mean(lateral**2)) < 0.01
    assert np.sqrt(np.mean(vertical**2)) < 0.01
    assert bore.length == pytest.approx(known.length, abs=0.15)
    assert np.sqrt(np.mean((bore.width - known.width) ** 2)) < 0.015
    assert np.sqrt(np.mean((bore.height - known.height) ** 2)) < 0.015
    assert not bore.filled.any()


def test_an_axis_knows_its_bend_to_the_left_and_its_grade(bore):
    np.testing.assert_allclose(bore.axis.curvature[30:-30], 1 / 60, rtol=0.02)
    np.testing.assert_allclose(bore.axis.grade[30:-30], 0.01, rtol=0.02)


def test_a_hole_in_the_survey_is_filled_and_marked():
    known = curved_d_bore(length=30, radius=1e6, grade=0.0, yaw=0.0, offset=(0, 0, 0))
    gone = (np.abs(known.points[:, 0] - 15) < 0.4) & (known.points[:, 2] > -2.5)
    bore, _ = rebuilt(known.points[~gone], STRAIGHT)
    keep(bore)
    at_hole = np.abs(bore.position[:, 0] + np.floor(np.median(known.points[:, 0])) - 15) < 0.2
    assert bore.filled[at_hole].all()
    assert np.abs(bore.width[at_hole] - known.width).max() < 0.05


RAILS, RAIL_TOP = 0.75, 0.24


def with_rails(cloud: np.ndarray, floor: float) -> np.ndarray:
    rng = np.random.default_rng(1)
    station = rng.uniform(0.0, 24.0, 40_000)
    rail = np.stack([station, rng.choice([-RAILS, RAILS], 40_000), floor + RAIL_TOP + 0.01 * station], axis=1)
    return np.concatenate([cloud, rail + rng.normal(0, [0.0, 0.03, 0.008], rail.shape) + PLACE])


@pytest.mark.parametrize("kind", ["d", "horseshoe", "circle on a floor"])
def test_the_corner_of_wall_and_floor_is_not_cut_off(kind):
    section = outline(kind)
    bore, cloud = rebuilt(with_rails(swept(kind, 24.0, yaw=0.0), section[:, 1].min()), midline(kind, 24.0, yaw=0.0))
    keep(bore)
    surface = bore.surface()[8:-8] + cloud.origin - PLACE
    wall = np.stack([surface[..., 1], surface[..., 2] - 0.01 * surface[..., 0]], axis=-1).reshape(-1, 2)
    true = LineString(section[np.argsort(np.arctan2(*section.T[::-1]))])
    away = true.distance(points(wall))
    assert away.max() < 0.06  # a degree of angle is 7 cm of wall: the very corner falls between two
    assert np.quantile(away, 0.99) < 0.02
    corner = section[np.argmax(np.hypot(section[:, 0], section[:, 1] - 0.5) * (section[:, 1] < 0))]
    gap = np.hypot(*(wall - corner).T).min(initial=np.inf)
    assert gap < 0.06


def test_a_clean_cloud_is_handed_on_as_it_is():
    cloud = thin(curved_d_bore(length=20).points)
    result = cleaned(cloud)
    assert result.cloud is cloud
    assert result.removed == ()
    assert not result.cause.any()
    assert len(result.cause) == len(cloud.points)


def test_what_was_removed_is_listed_by_stretch_with_its_place_in_the_frame_of_the_input():
    cloud = thin(curved_d_bore(length=20).points)
    station, cause = np.linspace(0, 20, len(cloud.points)), np.zeros(len(cloud.points), np.int8)
    cause[(station > 3) & (station < 5)] = Cause.INSIDE
    cause[(station > 8) & (station < 9)] = Cause.INSIDE
    cause[station > 19] = Cause.BEYOND
    removed = list_removed(cloud, cause, station, gap=1.0)
    assert [part.cause for part in removed] == [Cause.INSIDE, Cause.INSIDE, Cause.BEYOND]
    np.testing.assert_allclose([(part.start, part.end) for part in removed], [(3, 5), (8, 9), (19, 20)], atol=0.01)
    assert sum(part.points for part in removed) == np.count_nonzero(cause)
    there = np.median(cloud.points[cause == Cause.BEYOND], axis=0) + cloud.origin
    np.testing.assert_allclose(removed[-1].place, there, atol=1e-3)


def test_a_stray_beyond_a_mouth_is_cut_as_what_lies_beyond_it():
    grid = Grid.over(0.0, 20.0, 0.5, 120)
    wall, yes = np.full((grid.rows, 120), 3.0), np.ones((grid.rows, 120), bool)
    tube = Tube(grid, wall, wall, yes, yes, yes, ~yes, np.empty((0, 3)))
    station, upward = np.array([10.0, 25.0, 25.0, -5.0, 10.0]), np.array([3.0, 3.0, 3.0, 2.0, 3.5])
    supported = np.array([True, True, False, False, False])
    cause = sort_points(Around(station, np.zeros(5), upward), tube, supported, (0.0, 20.0))[1]
    assert cause.tolist() == [Cause.KEPT, Cause.BEYOND, Cause.BEYOND, Cause.BEYOND, Cause.SCATTERED]


@pytest.mark.parametrize("lean", [0.0, 0.25])
def test_a_mouth_that_the_axis_meets_aslant_ends_at_its_middle(lean: float):
    """Floor and crown of a mouth lie 1.4 m apart along an axis that leans from the bore by a quarter."""
    random = np.random.default_rng(3)
    angle = random.uniform(-np.pi, np.pi, 200_000)
    station = random.uniform(-2.0, 22.0, len(angle))
    inside = (station > lean * 2.75 * np.sin(angle)) & (station < 20.0 + lean * 2.75 * np.sin(angle))
    axis = axis_through(np.column_stack([np.linspace(0.0, 20.0, 21), np.zeros((21, 2))]), 1.0)
    assert visible_span(station[inside], angle[inside], axis) == pytest.approx((0.0, 20.0), abs=0.08)


def test_a_section_that_is_only_begun_at_a_mouth_does_not_bend_the_axis():
    """Before the mouth at 20.5 m, floor and walls go on for a metre, pulled aside; the crown does not."""
    random = np.random.default_rng(4)
    angle, station = random.uniform(-np.pi, np.pi, 60_000), random.uniform(0.0, 21.5, 60_000)
    kept = (station < 20.5) | (angle < 0.0)
    aside = np.where(station > 20.5, 0.25, 0.0)
    points = np.stack([station, 2.5 * np.cos(angle) + aside, 2.5 * np.sin(angle)], axis=1)[kept]
    axis = axis_through(np.column_stack([np.linspace(0.0, 20.0, 21), np.zeros((21, 2))]), 1.0)
    middles = section_middles(points, axis, lambda at: np.full((len(at.station), 72), 2.5))
    keep(middles)
    assert np.abs(middles[:, 1]).max() < 0.02
    assert middles[-1, 0] == pytest.approx(20.0, abs=1.01)


ANGLE = -np.pi + 2 * np.pi * (np.arange(120) + 0.5) / 120


def box(left: float, right: float, up: float, down: float) -> np.ndarray:
    """Distances to the sides of a box about the axis, m."""
    cos, sin = np.cos(ANGLE), np.sin(ANGLE)
    across = np.where(cos > 0, left, right) / np.abs(cos)
    return np.minimum(across, np.where(sin > 0, up, down) / np.abs(sin))


def round_thing(left: float, above: float, radius: float) -> np.ndarray:
    """Distances to a pipe, m; infinite beside it."""
    along = left * np.cos(ANGLE) + above * np.sin(ANGLE)
    inside = radius**2 - (left**2 + above**2 - along**2)
    return np.where((inside > 0) & (along > 0), along - np.sqrt(np.maximum(inside, 0.0)), np.inf)


CORRIDOR = box(2.55, 2.55, 2.2, 2.2)
ARCH = np.minimum(np.where(np.sin(ANGLE) > 0, 2.75, np.inf), box(2.75, 2.75, 9.0, 2.75))
HANGS = {
    "pipe": (CORRIDOR, round_thing(-1.1, 1.55, 0.16)),
    "two pipes": (CORRIDOR, np.minimum(round_thing(-1.1, 1.55, 0.16), round_thing(0.6, 1.55, 0.16))),
    "duct": (ARCH, round_thing(0.0, 2.0, 0.4)),
}


@pytest.mark.parametrize("name", HANGS)
def test_the_ceiling_goes_on_behind_what_hangs_under_it(name):
    bare, thing = HANGS[name]
    seen = np.minimum(bare, thing)
    assert (bare - seen).max() > 0.4
    bridged = bridge_hanging(np.stack([bare, seen]), ANGLE)
    keep(bridged)
    np.testing.assert_array_equal(bridged[0], bare)
    np.testing.assert_allclose(bridged[1], bare, atol=0.12)  # the line cuts a round crown's arc off


STAYS = {
    "corridor": CORRIDOR,
    "arch": ARCH,
    "a hall of 16 m": box(8.0, 8.0, 3.0, 1.5),
    "a haunch in the corner": np.minimum(CORRIDOR, 2.6 / np.abs(np.cos(ANGLE - np.pi / 4)).clip(0.3)),
    "a platform": np.minimum(CORRIDOR, np.where((ANGLE > -1.2) & (ANGLE < 0), 1.2 / np.abs(np.sin(ANGLE)), np.inf)),
    "something on the floor": np.minimum(CORRIDOR, np.where(np.abs(ANGLE + np.pi / 2) < 0.3, 1.2, np.inf)),
    "a crown that comes down": box(2.55, 2.55, 2.2, 2.2) - 0.3 * np.exp(-((ANGLE - np.pi / 2) ** 2) / 0.1),
}


@pytest.mark.parametrize("name", STAYS)
def test_walls_corners_and_what_stands_on_the_floor_stay(name):
    np.testing.assert_array_equal(bridge_hanging(STAYS[name][None], ANGLE)[0], STAYS[name])
