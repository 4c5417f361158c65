"""The B2 in a scene's own geometry, in MuJoCo's own engine."""

import dataclasses
import shutil
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.core import FrozenDict

import subterra_jax as st
from subterra_jax import lidar
from subterra_jax.b2 import constants as b2
from subterra_jax.b2.kinematics import standing_pose
from subterra_jax.b2.model import B2
from subterra_jax.host.rover import rover_mjcf
from subterra_jax.lidar import LidarParams
from subterra_jax.lidar3d import Relief, beams
from subterra_jax.lidar3d.space import Mount
from subterra_jax.parts import SensingState, make_sensor
from subterra_jax.physics.engine import TIMESTEP, Body, Build, MujocoEngine
from subterra_jax.physics.ground import SLEEPER_HALF, TrackError, read_track
from subterra_jax.physics.riding import Physical, SwayingLidar, SwayingSpatialLidar, yaw
from subterra_jax.physics.stage import scene_file, scene_world, tunnel_world
from subterra_jax.state import EnvParams
from subterra_jax.tunnel import Tunnel
from tests.subterra_jax.tunnels import straight, tunnel_arrays

ORIGIN = np.array([300.0, -40.0, -7.0])
N_SLEEPERS, SPACING = 12, 0.6
PLACE = ORIGIN + np.array([SPACING * 5, 0.0, 0.0])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0], np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A straight piece of track far from the origin: ballast, sleepers, two walls, and the rover of every scene."""
    folder = tmp_path_factory.mktemp("scene")
    root = rover_mjcf()
    world = root.find("worldbody")
    for k in range(N_SLEEPERS):
        _box(world, f"sleeper_{k:04d}", (*SLEEPER_HALF, 0.05), (SPACING * k, 0.0, -0.05), 5)
    _box(world, "bed_000", (6, 3, 0.1), (3.0, 0.0, -0.16), 5)
    for side in (1, -1):
        _box(world, f"low_wall_{side}", (6, 0.05, 1), (3.0, side * 0.65, 0.84), 8)
    (folder / "scene.xml").write_bytes(ElementTree.tostring(root))
    shutil.copy(Path(st.__file__).parent / "data" / "subterra-351.npz", folder / "tunnel.npz")
    return folder


def _box(world, name, size, away, bits):
    place = {"pos": _words(ORIGIN + away), "size": _words(size)}
    ElementTree.SubElement(world, "geom", name=name, type="box", contype=str(bits), conaffinity="0", **place)


def _words(numbers):
    return " ".join(f"{number:g}" for number in numbers)


@pytest.fixture(scope="module")
def scene(folder):
    return MujocoEngine(B2, world=lambda: scene_world(scene_file(folder, None)))


def standing(lateral=0.0, height=b2.STAND_HEIGHT):
    pose, hold = jax.device_get(standing_pose())
    qpos = np.concatenate([[0.0, lateral, height], LEVEL, pose]).astype(np.float32)
    return Body(qpos, np.zeros(18, np.float32), np.zeros(18, np.float32)), hold


def usual():
    one = np.ones(12, np.float32)
    return Build(np.float32(0.8), np.float32(1.0), np.zeros(3, np.float32), one, one)


def advance(engine, body, hold, origin):
    return engine.bench.run(body, hold, origin, usual(), engine.substeps)


def test_the_scene_keeps_everything_but_its_rover(scene):
    model = scene.bench.model
    assert not [model.body(k).name for k in range(model.nbody) if model.body(k).name.startswith("scout")]
    assert (model.nbody, model.nv, model.nu) == (1 + 1 + 12, 18, 12)
    assert model.opt.timestep == TIMESTEP


def test_it_stands_in_the_scene_as_on_the_floor_of_a_plan(scene, plan_of):
    plan = plan_of(tunnel_arrays(straight(20.0)))
    level = MujocoEngine(B2, world=lambda: tunnel_world(plan, read_track(plan)))
    (one, hold), (other, _) = standing(), standing()
    for _ in range(25):
        one = advance(level, one, hold, np.array([8.0, 0.0, 0.0]))
        other = advance(scene, other, hold, PLACE)
    assert float(other.qpos[2]) > 0.4
    assert np.abs(other.qvel).max() < 0.5
    # On the plan it has a floor at z = 0, in the scene sleepers there and the ballast 6 cm lower.
    assert 0.0 < float(one.qpos[2] - other.qpos[2]) < 0.065


def test_walls_of_the_scene_hold_it(scene):
    body, hold = standing(lateral=0.25)
    body = dataclasses.replace(body, qvel=np.concatenate([[0.0, 1.5], np.zeros(16)]).astype(np.float32))
    reached = 0.0
    for _ in range(25):
        body = advance(scene, body, hold, PLACE)
        reached = max(reached, float(body.qpos[1]))
    # Its bumpers have 0.225 m; the wall is 0.6 m from the axis.
    assert 0.3 < reached < 0.6 - b2.BUMPER_RADIUS + 0.02


def test_scenes_that_are_none_are_named(folder, tmp_path):
    with pytest.raises(TrackError, match=r"scene_furnished\.xml is missing"):
        scene_file(folder, "furnished")
    for text, message in (
        ("<mujoco><bad/></mujoco>", "not a readable scene"),
        ('<mujoco><worldbody><geom size="1" contype="8"/></worldbody></mujoco>', "the scene has no floor"),
    ):
        (tmp_path / "scene.xml").write_text(text)
        with pytest.raises(TrackError, match=rf"scene\.xml: .*{message}"):
            scene_world(tmp_path / "scene.xml")


SENSOR = LidarParams(fused=False)
ANCHOR, HEIGHT = 50, 0.5  # of the trunk's middle over the floor, m
MOTION = Physical(lidar_place=b2.LIDAR)


def moment(params, quaternion, offset):
    """Return the state that LiDARs see of a robot at an offset from its anchor, m."""
    body = SimpleNamespace(qpos=jnp.concatenate([offset, quaternion, jnp.zeros(12)]))
    ride, position = SimpleNamespace(body=body, anchor=jnp.int32(ANCHOR)), params.track.position[ANCHOR, :2]
    station = params.track.station[ANCHOR]
    return SensingState(params.tunnel, position + offset[:2], yaw(quaternion), station, {MOTION.name: ride})


def task(params, lidar, relief=None):
    return EnvParams(
        params.tunnel, jnp.int32(1), FrozenDict({"lidar": lidar, "track": params.track, "relief": relief}), "cover"
    )


@pytest.fixture(scope="module")
def world(plan_of):
    plan = plan_of(tunnel_arrays(straight(80.0)))
    return plan, SimpleNamespace(track=read_track(plan), tunnel=Tunnel.from_plan(plan, "smooth"))


@pytest.fixture(scope="module")
def look(world):
    _, params = world

    @jax.jit
    def ranges(quaternion, offset):
        return SwayingLidar(motion=MOTION).true_ranges((), moment(params, quaternion, offset), task(params, SENSOR))

    return lambda quaternion, lateral=0.0: ranges(jnp.asarray(quaternion), jnp.array([0.0, lateral, HEIGHT]))


def leaning(angle, axis):
    """A quaternion of a turn about x (roll), y (pitch) or z (yaw)."""
    return np.cos(angle / 2), *(np.sin(angle / 2) * np.eye(3)["xyz".index(axis)])


def test_level_it_sees_what_the_planar_lidar_sees_from_the_same_place(world, look):
    _, params = world
    yaw, station = 0.1, params.track.station[ANCHOR]
    mount = b2.LIDAR[0] * np.array([np.cos(yaw), np.sin(yaw)]) + [0.0, 0.3]
    place = params.track.position[ANCHOR, :2] + jnp.asarray(mount, jnp.float32)
    planar = jax.jit(lidar.scan)(params.tunnel, place, jnp.float32(yaw), station, SENSOR)
    np.testing.assert_allclose(look(leaning(yaw, "z"), 0.3), planar, rtol=1e-4)


def test_nose_down_the_beam_ahead_ends_on_the_ballast(world, look):
    plan, params = world
    pitch = 0.1
    height = HEIGHT + b2.LIDAR[2] * np.cos(pitch) - b2.LIDAR[0] * np.sin(pitch) + float(params.track.protrusion[ANCHOR])
    ranges = look(leaning(pitch, "y"))
    assert float(ranges[0]) == pytest.approx(height / np.sin(pitch), rel=1e-4)
    half_width = float(np.interp(0.6 * ANCHOR, plan.station, plan.half_width))
    assert float(ranges[4]) == pytest.approx(half_width, rel=1e-3)  # the beam to the side has stayed level


def test_rolled_the_beams_to_the_sides_are_longer_by_the_cosine(world, look):
    plan, _ = world
    roll = -0.1  # the left side goes down
    half_width = float(np.interp(0.6 * ANCHOR, plan.station, plan.half_width))
    aside = -b2.LIDAR[2] * np.sin(roll)
    ranges = look(leaning(roll, "x"))
    assert float(ranges[4]) == pytest.approx((half_width - aside) / np.cos(roll), rel=1e-3)
    assert float(ranges[12]) == pytest.approx((half_width + aside) / np.cos(roll), rel=1e-3)


def test_on_its_back_nothing_is_nan(look):
    for angle in (np.pi / 2, np.pi):
        assert np.isfinite(look(leaning(angle, "x"))).all()
        assert np.isfinite(look(leaning(angle, "y"))).all()


@pytest.fixture(scope="module")
def in_space(world):
    """Ranges of a LiDAR in three dimensions, and of the planar one, which sees the same surface from the same place."""
    plan, params = world
    relief = Relief.from_plan(plan, "smooth")

    @jax.jit
    def ranges(quaternion, mount):
        sensing = moment(params, quaternion, jnp.array([0.0, 0.3, HEIGHT]))
        spatial = task(params, make_sensor(beams.planar(16), mount=mount), relief)
        met, *_ = SwayingSpatialLidar(motion=MOTION).look((), sensing, None, spatial)
        return met.ranges, SwayingLidar(motion=MOTION).true_ranges((), sensing, task(params, SENSOR, relief))

    return lambda quaternion, **mount: jax.device_get(ranges(jnp.asarray(quaternion, jnp.float32), Mount(**mount)))


@pytest.mark.parametrize(("angle", "axis"), [(0.2, "x"), (0.15, "y"), (0.4, "z")])
def test_in_three_dimensions_it_leans_with_the_trunk(in_space, angle, axis):
    spatial, planar = in_space(leaning(angle, axis))
    np.testing.assert_allclose(spatial, planar, atol=1e-3)
    assert np.ptp(spatial) > 5.0


def test_a_mount_is_turned_and_moved_aside_on_the_trunk(in_space):
    level = leaning(0.0, "z")
    straight, _ = in_space(level)
    turned, _ = in_space(level, yaw=np.pi / 2)
    np.testing.assert_allclose(turned, np.roll(straight, -4), atol=1e-3)
    aside, _ = in_space(level, lateral=0.2)
    assert aside[4] == pytest.approx(straight[4] - 0.2, abs=2e-3)
    assert aside[12] == pytest.approx(straight[12] + 0.2, abs=2e-3)
    down, _ = in_space(level, pitch=0.1)
    leant, _ = in_space(leaning(0.1, "y"))
    assert down[0] == pytest.approx(leant[0], abs=0.5)  # from a place that the leaning trunk has lowered
    assert down[0] < 12.0
