"""Brightness and speeds in recordings: fixed to the wall, equal to the batch's, and what two programs make of them."""

import dataclasses
from itertools import islice
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import subterra_jax as st
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

SEED, BATCH_SEED = np.random.SeedSequence(4), 5
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


def unrolled(texture, seed=None):
    """By cell, the brightness of two sweeps 0.45 m apart at their true places."""
    scene = drawn(texture)
    bore, lidar = scene.drive.bore, scene.sensor.lidar
    face = Face(bore.alignment, bore.section, texture, seed) if seed is not None else record.face_of(scene)
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


def test_smooth_walls_are_driven_by_their_brightness():
    assert advance(odometry.by_brightness(), drawn(1.0), 28) < 0.03


@pytest.mark.slow
def test_without_brightness_the_way_is_lost():
    assert advance(odometry.by_brightness(), drawn(0.0), 28) > 0.9


def test_doppler_gives_the_way_where_walls_are_smooth():
    assert advance(odometry.by_doppler(), drawn(0.0, doppler=True), 28) < 0.01


def test_poses_are_of_the_ends_of_sweeps(monkeypatch):
    points, rest = np.ones(9, DOPPLER_POINT), (np.array([0.0, 0.0, 9.81]), np.zeros(3))
    samples = [(1_900_000_000, rest), (2_000_000_000, points), (2_100_000_000, points)]
    monkeypatch.setattr(odometry, "read_samples", lambda path: iter(samples))
    times, poses, _ = odometry.run(lambda: lambda seen, attitude, rate: np.array([1.0, 2.0, 3.0]), Path("a.bag"))
    np.testing.assert_allclose(times, [2.1, 2.2])
    np.testing.assert_allclose(poses[:, :3, 3], [[1.0, 2.0, 3.0]] * 2)


def test_recordings_without_the_channel_are_refused():
    points = np.zeros(50, DOPPLER_POINT)
    points["x"], points["intensity"] = np.arange(50), 30.0
    with pytest.raises(BenchmarkError, match="intensities are constant"):
        odometry.by_brightness()(points, Rotation.identity(), np.zeros(3))
    with pytest.raises(BenchmarkError, match="no velocity"):
        odometry.by_doppler()(points[["x", "y", "z"]], Rotation.identity(), np.zeros(3))


def test_bag_and_batch_show_one_wall():
    bag = unrolled(1.0, seed=BATCH_SEED)[0]
    station = np.linspace(0.0, 65.0, 131)
    plan = st.tunnel.from_centreline(np.stack([station, np.zeros(131)], axis=-1), 2.8, lidar_height=0.7)
    plan = dataclasses.replace(plan, texture=BATCH_SEED)
    env, params = st.make("Subterra/Traverse-v1", tunnel=plan, sensor="vlp16", intensity=True, texture=1.0)
    x = np.mean([k[0] for k in bag]) * 0.05

    @jax.jit
    def look():
        state = env.begin(env.draw_reset(jax.random.key(0), (), params), params)
        place = {"position": jnp.array([x, 0.0], jnp.float32), "station": jnp.float32(x), "heading": jnp.float32(0.0)}
        return env.observe(state.replace(**place), env.draw_step(jax.random.key(1), (), params), params)

    flat = np.asarray(look())
    scan, shown = (flat[env.fields(params)[name]] for name in ("scan", "intensity"))
    rays = np.asarray(params.lidar.directions)
    points = rays * scan[:, None] + (x, 0.0, 0.7)
    near = (shown > 0.0) & (np.abs(points[:, 0] - x) < 3.0) & (np.abs(points[:, 2] - 1.1) < 0.9)
    near &= np.abs(points[:, 1]) > 2.7
    angle = wall_angle(np, points[near, 1], points[near, 2])
    batch = by_cell(points[near, 0], angle, np.log(shown[near] / np.abs(rays[near, 1])))
    assert likeness(bag, batch) > 0.6
