"""Brightness and speeds in recordings: fixed to the wall, and what two programs make of them."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.command import BenchmarkError
from benchmarks.slam import odometry
from benchmarks.slam.arena import record
from benchmarks.slam.arena.drives import REST, ramp_up
from benchmarks.slam.reading import DOPPLER_POINT
from scene.survey.bore import draw_bore
from scene.survey.cast import Face
from scene.survey.mesh import Part
from subterra_jax.host.texture import brightness, wall_angle
from tests.recorded import check

SEED = np.random.SeedSequence(4)
VALUES = Path(__file__).with_name("values.csv")


def test_brightness_of_the_survey_is_that_of_station_and_angle_in_a_bend():
    bore = draw_bore(np.random.SeedSequence(1), 60.0, "metro")
    station, left, up = np.array([12.3, 30.0, 47.7]), np.array([2.5, -2.7, 0.3]), np.array([0.4, -1.0, 2.4])
    points = bore.alignment.frames(station).point(left, up)
    face = Face(bore.alignment, bore.section, 1.0, 9)
    above = up + 0.5 * bore.section.height(station)
    expected = brightness(np, station, wall_angle(np, left, above), 9, 1.0)
    np.testing.assert_allclose(face(25.0, points, np.full(3, Part.LINING)), expected, rtol=1e-2)
    np.testing.assert_array_equal(face(25.0, points, np.full(3, Part.RAIL)), 1.0)


def test_a_sweep_shows_the_face_of_the_wall_and_the_speed_of_each_return():
    scene = record.draw_scene(record.Course("one", "smooth", distance=9.0, texture=1.0, doppler=True), SEED)
    sweep = next(islice(record.cast_sweeps(scene), 40, None))
    seen, speeds = sweep.points[sweep.valid], sweep.velocity[sweep.valid]
    ahead = seen[:, 0] / np.linalg.norm(seen, axis=1)
    speed = 1.5 * ramp_up(np.array([4.05]), REST, 2.0)[0]
    assert -np.polyfit(ahead, speeds, 1)[0] == pytest.approx(speed, rel=0.02)
    np.testing.assert_allclose(speeds, -speed * ahead, atol=0.25)
    check(VALUES, "sweep", {"bright": sweep.reflectivity, "speeds": sweep.velocity, "valid": sweep.valid}, rel=1e-3)


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
