"""The B2 in a scene's own geometry, in MuJoCo's own engine."""

import dataclasses
import shutil
from pathlib import Path
from xml.etree import ElementTree

import jax
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.b2 import constants as b2
from subterra_jax.b2.kinematics import standing_pose
from subterra_jax.b2.model import B2
from subterra_jax.host.rover import rover_mjcf
from subterra_jax.physics.engine import TIMESTEP, Body, Build, MujocoEngine
from subterra_jax.physics.ground import SLEEPER_HALF, TrackError, read_track
from subterra_jax.physics.stage import scene_file, scene_world, tunnel_world
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
