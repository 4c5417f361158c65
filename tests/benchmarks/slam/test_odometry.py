"""Brightness and speeds in recordings: fixed to the wall, and what two programs make of them."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.command import BenchmarkError
from benchmarks.slam import odometry
from benchmarks.slam.arena import record
from benchmarks.slam.reading import DOPPLER_POINT
from scene.survey.bore import draw_bore
from scene.survey.carrier import Carried
from scene.survey.cast import Caster, Face, sweeps
from scene.survey.config import SensorErrors
from scene.survey.mesh import Part
from subterra_jax.host.texture import brightness, wall_angle
from tests.recorded import check

SEED = np.random.SeedSequence(4)
VALUES = Path(__file__).with_name("values.csv")
KEPT = 34  # sweeps of the rest that tests leave out


def drawn(texture, doppler=False, distance=3.0):
    return record.draw_scene(record.Course("one", "smooth", distance=distance, texture=texture, doppler=doppler), SEED)


def points_of(sweep):
    points = np.zeros(int(sweep.valid.sum()), DOPPLER_POINT)
    points["x"], points["y"], points["z"] = sweep.points[sweep.valid].T
    points["intensity"], points["t"] = sweep.reflectivity[sweep.valid], sweep.offset[sweep.valid]
    if sweep.velocity is not None:
        points["velocity"] = sweep.velocity[sweep.valid]
    return points


def unrolled(texture):
    """By cell, the brightness of two sweeps 0.45 m apart at their true places."""
    scene = drawn(texture)
    bore, lidar = scene.drive.bore, scene.sensor.lidar
    face = record.face_of(scene)
    caster, carried = Caster(bore.mesh(), lidar.range_max), Carried(scene.drive, record._HERE)
    seen = sweeps(np.random.default_rng(0), lidar, carried, caster, SensorErrors(), every=3, face=face)
    frames, images = bore.alignment.frames(np.array([scene.drive.begin])), []
    for sweep in islice(seen, 14, 16):
        true = carried.poses(1e-9 * (sweep.begin + sweep.offset[sweep.valid]))
        returns = true.position + Rotation.from_quat(true.quaternion).apply(sweep.points[sweep.valid])
        placed = (returns - frames.position[0]) @ frames.matrix[0]
        pose = scene.drive.poses(np.array([1e-9 * sweep.begin + 0.05])).position[0]
        sensor = (pose - frames.position[0]) @ frames.matrix[0]
        along, angle, value = odometry.unroll(placed - sensor, sweep.reflectivity[sweep.valid].astype(float))
        near = (np.abs(along) < 3.0) & (np.abs(np.abs(angle) - 1.5) < 0.35)  # without the floor
        images.append(by_cell(scene.drive.begin + sensor[0] + along[near], angle[near], value[near]))
    return images


def by_cell(station, angle, value):
    cell = np.stack([np.floor(station / 0.05), np.floor(angle * 2.8 / 0.05)], axis=1).astype(int)
    keys, where = np.unique(cell, axis=0, return_inverse=True)
    mean = np.bincount(where.ravel(), value) / np.bincount(where.ravel())
    return dict(zip(map(tuple, keys.tolist()), mean, strict=True))


def likeness(one, other):
    both = sorted(one.keys() & other.keys())
    assert len(both) > 300
    return np.corrcoef([one[k] for k in both], [other[k] for k in both])[0, 1]


def test_two_sweeps_of_a_bag_have_the_wall_in_common_by_the_dial():
    found = [likeness(*unrolled(texture)) for texture in (0.0, 0.25, 1.0)]
    print("correlation by dial", np.round(found, 3))
    assert found[0] <= 0.05
    assert found[2] >= 0.6
    assert found[0] < found[1] < found[2]


def test_brightness_of_the_survey_is_that_of_station_and_angle_in_a_bend():
    bore = draw_bore(np.random.SeedSequence(1), 60.0, "metro")
    station, left, up = np.array([12.3, 30.0, 47.7]), np.array([2.5, -2.7, 0.3]), np.array([0.4, -1.0, 2.4])
    points = bore.alignment.frames(station).point(left, up)
    face = Face(bore.alignment, bore.section, 1.0, 9)
    above = up + 0.5 * bore.section.height(station)
    expected = brightness(np, station, wall_angle(np, left, above), 9, 1.0)
    np.testing.assert_allclose(face(25.0, points, np.full(3, Part.LINING)), expected, rtol=1e-2)
    np.testing.assert_array_equal(face(25.0, points, np.full(3, Part.RAIL)), 1.0)


def advance(step, scene, skip=KEPT):
    """The step over the moving part of a drive; what of the way it lost."""
    seen = islice(record.cast_sweeps(scene), skip, None)
    way = [step(points_of(sweep), Rotation.identity(), np.zeros(3)) for sweep in seen]
    return abs((way[-1] - way[0])[0] - scene.course.distance) / scene.course.distance  # ahead is forward


def test_doppler_gives_the_way_where_walls_are_smooth():
    assert advance(odometry.by_doppler(), drawn(0.0, doppler=True), 28) < 0.01


RATE, BIAS = np.array([0.0, 0.0, 0.12]), np.array([0.01, -0.02, 0.03])  # rad/s
START, LOOKS = 1.2, 0.3  # s; rad to the left


def tube(texture, noise):
    """Samples of a drive at 1 m/s down a round tube, after a rest; the true attitude at times."""
    rng, n, samples = np.random.default_rng(0), 4000, []
    wave = rng.uniform(2.0, 9.0, 40), rng.integers(-9, 10, 40), rng.uniform(0.0, 7.0, 40)
    rest = Rotation.from_euler("ZYX", [LOOKS, 0.05, -0.04])
    attitude = lambda t: rest * Rotation.from_rotvec(np.outer(np.maximum(t - START, 0.0), RATE))  # noqa: E731
    for t in np.arange(1, 481) / 200.0:
        force = attitude(np.array([t]))[0].inv().apply([0.0, 0.0, 9.81])
        samples.append((t, round(1e9 * t), (force, BIAS + RATE * (t > START))))
    for begin in np.arange(1.0, 2.35, 0.1):
        t, turn, ahead = begin + np.linspace(0.0, 0.0999, n), rng.uniform(-np.pi, np.pi, n), rng.uniform(-6.5, 6.5, n)
        ray = np.stack([ahead, 2.8 * np.cos(turn), 2.8 * np.sin(turn)], axis=1)
        far, points = np.linalg.norm(ray, axis=1), np.zeros(n + 1, DOPPLER_POINT)  # the last came back from nowhere
        bright = np.cos(np.outer(np.maximum(t - START, 0.0) + ahead, wave[0]) + np.outer(turn, wave[1]) + wave[2]).sum(
            axis=1
        )
        for name, column in zip("xyz", attitude(t).inv().apply(ray).T, strict=True):
            points[name][:n] = column
        points["intensity"][:n] = 40.0 * np.exp(0.15 * texture * bright + noise * rng.normal(size=n)) / far
        points["t"][:n], points["velocity"][:n] = np.rint(1e9 * (t - begin)), -ahead / far * (t > START)
        samples.append((begin + 0.1, round(1e9 * begin), points))
    return [row[1:] for row in sorted(samples, key=lambda row: row[0])], attitude


@pytest.mark.parametrize(("make", "texture", "noise"), [
    (odometry.by_doppler, 0.0, 0.0), (odometry.by_brightness, 1.0, 0.0), (odometry.by_brightness, 0.2, 2.0),
])  # fmt: skip
def test_the_way_down_a_tube_and_the_attitude_are_found_at_the_ends_of_sweeps(make, texture, noise, monkeypatch):
    samples, attitude = tube(texture, noise)
    monkeypatch.setattr(odometry, "read_samples", lambda path: iter(samples))
    time, poses, seconds = odometry.run(make, Path("a.bag"))
    np.testing.assert_allclose(time, np.arange(1.1, 2.45, 0.1))
    yaw, *tilt = (Rotation.from_matrix(poses[:, :3, :3]) * attitude(time).inv()).as_euler("ZYX").T
    np.testing.assert_allclose([yaw + LOOKS, *tilt], 0.0, atol=2e-3)
    assert 0.0 < seconds < 5.0
    if noise == 0.0:
        way, aside = np.array([[np.cos(LOOKS), -np.sin(LOOKS)], [np.sin(LOOKS), np.cos(LOOKS)]]) @ poses[:, :2, 3].T
        np.testing.assert_allclose(np.diff(way)[7:], 0.1, atol=0.005)
        np.testing.assert_allclose(aside, 0.0, atol=0.012)
    check(VALUES, f"{make.__name__} {100 * texture:.0f}", poses[:, :3, 3])


def test_recordings_without_the_channel_are_refused():
    points = np.zeros(50, DOPPLER_POINT)
    points["x"], points["intensity"] = np.arange(50), 30.0
    with pytest.raises(BenchmarkError, match="intensities are constant"):
        odometry.by_brightness()(points, Rotation.identity(), np.zeros(3))
    with pytest.raises(BenchmarkError, match="no velocity"):
        odometry.by_doppler()(points[["x", "y", "z"]], Rotation.identity(), np.zeros(3))
