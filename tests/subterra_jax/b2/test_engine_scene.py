"""The B2 in a scene's own geometry does what it does on the window of track."""

import dataclasses
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.b2 import constants as b2
from subterra_jax.b2.engine import MujocoPhysics, ScenePhysics, walk_in_scene
from subterra_jax.b2.kinematics import standing_pose
from subterra_jax.b2.params import Body, Build, Surroundings
from subterra_jax.b2.tasks import make
from subterra_jax.b2.track import SLEEPER_HALF, TrackError

ORIGIN = np.array([300.0, -40.0, -7.0])
N_SLEEPERS, SPACING = 12, 0.6
LEVEL = np.array([1.0, 0.0, 0.0, 0.0], np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A straight piece of track far from the origin: ballast, sleepers, two walls, and the scout of every scene."""
    folder = tmp_path_factory.mktemp("scene")
    lines = []
    for k in range(N_SLEEPERS):
        x, y, z = ORIGIN + np.array([SPACING * k, 0.0, -0.05])
        size = f"{SLEEPER_HALF[0]} {SLEEPER_HALF[1]} 0.05"
        lines.append(f'<geom name="sleeper_{k:04d}" type="box" size="{size}" pos="{x} {y} {z}" contype="5"/>')
    x, y, z = ORIGIN + np.array([3.0, 0.0, -0.06 - 0.1])
    lines.append(f'<geom name="bed_000" type="box" size="6 3 0.1" pos="{x} {y} {z}" contype="5"/>')
    for side in (1, -1):
        pos = f"{x} {y + side * 0.65} {z + 1}"
        lines.append(f'<geom name="low_wall_{side}" type="box" size="6 0.05 1" pos="{pos}" contype="8"/>')
    lines.append(f'<body name="scout" pos="{x} {y} {z + 0.3}"><freejoint/><geom size="0.1" conaffinity="15"/></body>')
    (folder / "scene.xml").write_text(f"<mujoco><worldbody>{''.join(lines)}</worldbody></mujoco>")
    shutil.copy(Path(st.__file__).parent / "data" / "subterra-351.npz", folder / "tunnel.npz")
    return folder


@pytest.fixture(scope="module")
def scene(folder):
    return ScenePhysics(scene=folder / "scene.xml")


def standing(lateral=0.0, height=b2.STAND_HEIGHT):
    pose, hold = jax.device_get(standing_pose())
    qpos = np.concatenate([[0.0, lateral, height], LEVEL, pose]).astype(np.float32)
    return Body(qpos, np.zeros(18, np.float32), np.zeros(18, np.float32)), hold


def usual():
    one = np.ones(12, np.float32)
    return Build(np.float32(0.8), np.float32(1.0), np.zeros(3, np.float32), one, one)


def around(k, half_width=2.0):
    """On the window of track, with the anchor at sleeper k; and in the scene."""
    first = k - 1
    tops = np.array([[SPACING * (first + j - k), 0.0, -0.05] for j in range(4)])
    rails = np.array([[0.0, 50.0, -9.0], [0.0, -50.0, -9.0]])
    positions = np.concatenate([[[0.0, 0.0, -0.06]], tops, rails]).astype(np.float32)
    window = Surroundings((positions, np.tile(LEVEL, (7, 1))), LEVEL, np.float32(half_width))
    return window, window.replace(origin=ORIGIN + np.array([SPACING * k, 0.0, 0.0]))


def test_the_scene_keeps_everything_but_the_scout(scene):
    model = scene.bench.model
    names = [model.body(k).name for k in range(model.nbody)]
    assert "scout" not in names
    assert len(names) == 1 + 1 + 12
    assert model.nv == 18
    assert model.opt.timestep == b2.TIMESTEP


def test_it_stands_in_the_scene_as_on_the_window_of_track(scene):
    window, placed = around(5)
    (one, hold), build = standing(), usual()
    other, on_window = one, MujocoPhysics()
    for _ in range(25):
        one = on_window.run_one(one, hold, window, build)
        other = scene.run_one(other, hold, placed, build)
    # The scene's solver takes more iterations.
    np.testing.assert_allclose(other.qpos, one.qpos, atol=0.02)
    assert float(other.qpos[2]) > 0.4
    assert np.abs(other.qvel).max() < 0.5


def test_walls_of_the_scene_hold_it(scene):
    _, placed = around(5)
    body, hold = standing(lateral=0.25)
    body = dataclasses.replace(body, qvel=np.concatenate([[0.0, 1.5], np.zeros(16)]).astype(np.float32))
    reached = 0.0
    for _ in range(25):
        body = scene.run_one(body, hold, placed, usual())
        reached = max(reached, float(body.qpos[1]))
    # The trunk is 0.14 m to either side; the wall is 0.6 m from the axis.
    assert 0.40 < reached < 0.52


def test_sleepers_are_walked_on_where_the_scene_has_them(folder):
    walk, params = make(scene=folder, driven=True)
    placed = walk_in_scene(walk, folder, None)
    assert placed.physics.scene == folder / "scene.xml"
    assert params.track.station.shape == (N_SLEEPERS,)
    with pytest.raises(TrackError, match=r"scene_furnished\.xml is missing"):
        walk_in_scene(walk, folder, "furnished")


def test_a_spoiled_scene_is_named(tmp_path):
    (tmp_path / "scene.xml").write_text("<mujoco><bad/></mujoco>")
    with pytest.raises(TrackError, match=r"scene\.xml: not a readable scene"):
        ScenePhysics(scene=tmp_path / "scene.xml").scene_spec()
