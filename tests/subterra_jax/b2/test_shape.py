"""Looks of the B2: closed surfaces about its collision shapes, which change nothing of its motion."""

import mujoco
import numpy as np
import pytest
import trimesh

from subterra_jax.b2 import constants as b2
from subterra_jax.b2.model import dress, robot_spec
from subterra_jax.b2.shape import shape_of
from subterra_jax.host.rover import GROUND
from tests.subterra_jax.b2.conftest import standing

BODIES = ("base_link", *(f"{leg}_{part}" for leg in b2.LEGS for part in b2.PARTS))


@pytest.mark.parametrize("body", BODIES)
def test_each_part_is_closed_and_seen_from_outside(body):
    for part in shape_of(body):
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=True)
        assert mesh.is_watertight
        assert mesh.volume > 0.0


def test_an_unknown_body_has_no_looks():
    with pytest.raises(KeyError):
        shape_of("XX_thigh")


@pytest.fixture(scope="module")
def models():
    plain, dressed = robot_spec(), robot_spec()
    dress(dressed)
    for spec in (plain, dressed):
        ground = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": (5.0, 5.0, 1.0)}
        spec.worldbody.add_geom(name="ground", contype=GROUND, conaffinity=0, **ground)
    return plain.compile(), dressed.compile()


def test_the_robot_moves_by_the_same_bits_with_its_looks_as_without(models):
    ends = []
    for model in models:
        data = standing(model)
        hold = data.ctrl.copy()
        for step in range(300):
            data.ctrl[:] = hold + 0.3 * np.sin(0.05 * step + np.arange(12))
            mujoco.mj_step(model, data)
        ends.append((data.qpos.tobytes(), data.qvel.tobytes(), data.qacc.tobytes()))
    assert ends[0] == ends[1]
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        assert getattr(models[0], name).tobytes() == getattr(models[1], name).tobytes(), name


def test_physics_has_no_looks_and_looks_touch_nothing(models):
    plain, dressed = models
    assert not (plain.geom_type == mujoco.mjtGeom.mjGEOM_MESH).any()
    looks = dressed.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    assert looks.sum() == sum(len(shape_of(body)) for body in BODIES)
    assert not dressed.geom_contype[looks].any()
    assert not dressed.geom_conaffinity[looks].any()
    own = dressed.geom_bodyid > 0
    assert (dressed.geom_group[looks] == 2).all()
    assert (dressed.geom_group[own & ~looks] == 3).all()


def test_it_stands_within_the_makers_envelope(models):
    model = models[1]
    data = standing(model)
    mujoco.mj_kinematics(model, data)
    points = []
    for body in BODIES:
        turn, middle = data.body(body).xmat.reshape(3, 3), data.body(body).xpos
        points += [part.vertices @ turn.T + middle for part in shape_of(body)]
    points = np.concatenate(points)
    length, width, height = np.ptp(points, axis=0)
    assert points[:, 2].min() == pytest.approx(0.0, abs=0.003)
    # The LiDAR's housing stands higher than the data sheet's robot without one.
    assert length < b2.ENVELOPE[0]
    assert width == pytest.approx(b2.ENVELOPE[1], abs=0.06)
    assert height == pytest.approx(b2.STAND_HEIGHT + b2.LIDAR[2] + 0.06, abs=0.01)
