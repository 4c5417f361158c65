"""Trackers of the station on the arena's drives: scans of one line, the map, and errors of an odometer taken out."""

import numpy as np
import pytest

from benchmarks.slam import trackers
from benchmarks.slam.arena.record import Course, Scene, draw_scene
from benchmarks.slam.reading import POINT
from scene.survey.cast import Caster

SPEED, BEHIND, WAY = 1.5, 20.0, 12.0  # m/s; m
LONG = 1.03  # a metre by the odometer, m


def sweep(ways: np.ndarray, reach: np.ndarray, ring: np.ndarray, time: np.ndarray) -> np.ndarray:
    points = np.zeros(len(ways), POINT)
    for k, name in enumerate(("x", "y", "z")):
        points[name] = ways[:, k] * reach
    points["ring"], points["t"] = ring, np.rint(1e9 * time)
    return points


def room(bearing: np.ndarray) -> np.ndarray:
    """Ranges in a room of 4 m x 6 m, m."""
    return np.minimum(2.0 / np.maximum(abs(np.cos(bearing)), 1e-9), 3.0 / np.maximum(abs(np.sin(bearing)), 1e-9))


def test_a_slice_is_what_stands_at_its_height_turned_back_and_at_one_time():
    angle = np.deg2rad(np.arange(0.0, 360.0, 0.5))
    time = np.linspace(0.0, 0.1, len(angle), endpoint=False)
    heading, velocity = np.deg2rad(30.0), np.array([2.0, 0.0, 0.0])
    level = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    parts = []
    # The room as far as 0.3 m over the floor and from 1 m on is smaller, by half.
    for ring, (over_floor, factor) in enumerate(((0.3, 0.5), (trackers.SLICE + 0.05, 1.0), (1.0, 0.5))):
        ends = level * (factor * room(angle + heading))[:, None] - velocity * (time - 0.05)[:, None]
        ends[:, 2] = over_floor - 1.5
        far = np.linalg.norm(ends, axis=1)
        parts.append(sweep(ends / far[:, None], far, np.full(len(angle), ring), time))
    parts.append(sweep(level, np.zeros(len(angle)), np.zeros(len(angle)), time))
    ranges = trackers.slice_cloud(np.concatenate(parts), 1.5, velocity, heading)
    beams = np.arange(trackers.N_BEAMS) * 2.0 * np.pi / trackers.N_BEAMS
    np.testing.assert_allclose(ranges, room(beams), atol=0.03)
    assert trackers._sees_walls(ranges)


def test_a_lidar_that_looks_ahead_only_does_not_see_both_walls():
    angle = np.deg2rad(np.arange(-35.0, 35.0, 0.5))
    ways = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    ahead = sweep(ways, np.full(len(ways), 5.0), np.zeros(len(ways)), 0.0 * angle)
    assert not trackers._sees_walls(trackers.slice_cloud(ahead, trackers.SLICE, np.zeros(3), 0.0))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return draw_scene(Course("one", "pockets", distance=WAY), np.random.SeedSequence(6))


@pytest.fixture(scope="module")
def steps(scene: Scene) -> list[trackers.Step]:
    """Planar scans of a way along the bore from its begin, 2 m/s, with noise of 2 cm; the odometer is 3 % long."""
    bore, rng = scene.drive.bore, np.random.default_rng(0)
    caster = Caster(bore.mesh(), 30.0)
    beams = np.arange(trackers.N_BEAMS) * 2.0 * np.pi / trackers.N_BEAMS
    made = []
    for k, station in enumerate(np.arange(scene.drive.begin, scene.drive.begin + WAY, 0.1)):
        frames = bore.alignment.frames(np.array([station]))
        at = frames.point(np.zeros(1), trackers.SLICE - 0.5 * bore.section.height(np.array([station])))
        ways = np.cos(beams)[:, None] * frames.tangent + np.sin(beams)[:, None] * frames.lateral
        caster.load(float(station), at[0])
        ranges = caster.cast_loaded(np.repeat(at, len(beams), axis=0), ways).distance
        noisy = np.minimum(ranges + 0.02 * rng.standard_normal(len(beams)), 30.0)
        made.append(trackers.Step(noisy, LONG * 0.1 * (k > 0)))
    return made


def test_the_map_holds_what_stands_at_the_height_of_the_slice(scene):
    walls = trackers.map_walls(scene)
    wall = np.asarray(walls.wall)
    assert wall.shape == (2, int(scene.drive.bore.alignment.length / 0.02))
    assert abs(float(walls.half_width) - np.median(wall)) < 0.01
    assert 0.05 < wall.max() - np.median(wall) < 0.2  # a pocket, blurred
    assert np.asarray(walls.spread).max() > 100.0 * np.median(np.asarray(walls.spread))


@pytest.mark.parametrize(("name", "within"), [("particle-filter", 0.1), ("ring-filter", 0.2)])
def test_trackers_take_out_the_error_of_the_odometer(scene, steps, name, within):
    tracker = trackers.track_map(scene) if name == "particle-filter" else trackers.track_rings()
    way = (len(steps) - 1) * 0.1
    error = [tracker(step) for step in steps][-1] - way
    assert abs(error) < within
    assert abs((LONG - 1.0) * way) > 0.3
