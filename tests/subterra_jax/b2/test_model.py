"""The robot's MJCF against its figures; its looks change nothing of its motion."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh

from subterra_jax.b2 import constants as b2
from subterra_jax.b2.kinematics import standing_pose
from subterra_jax.b2.model import B2, dress, robot_spec
from subterra_jax.b2.shape import shape_of
from subterra_jax.host.rover import GROUND
from subterra_jax.physics.engine import Build, Engine
from subterra_jax.physics.ground import N_PLANES
from tests.subterra_jax.b2.conftest import standing

# Principal moments, from MuJoCo's own reading of the URDF (trunk) and from the mean leg, kg m².
PRINCIPAL = {
    "base_link": (1.77511065, 1.70382523, 0.345842332),
    "hip": (0.00493975724, 0.00384114363, 0.00311702698),
    "thigh": (0.0640935365, 0.0634463385, 0.00699945276),
    "calf": (0.0169204831, 0.0167821849, 0.000404298448),
}


@pytest.fixture(scope="module")
def model():
    return robot_spec().compile()


@pytest.fixture(scope="module")
def on_floor():
    spec = robot_spec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 1), contype=GROUND, conaffinity=0)
    return spec.compile()


def test_the_robot_weighs_what_the_urdf_says(model):
    assert model.body_mass.sum() == pytest.approx(74.5803, abs=1e-4)
    assert model.body("base_link").mass[0] == pytest.approx(41.4371)


def test_every_body_has_the_moments_of_inertia_of_the_figures(model):
    for body in range(1, model.nbody):
        name = model.body(body).name
        expected = PRINCIPAL[name if name in PRINCIPAL else name.split("_")[1]]
        np.testing.assert_allclose(sorted(model.body_inertia[body]), sorted(expected), rtol=2e-6)


def test_left_and_right_legs_are_mirror_images(model):
    mass = mujoco.MjData(model)
    mass.qpos[3], mass.qpos[7:] = 1.0, standing_pose()[0]
    mujoco.mj_forward(model, mass)
    for left, right in (("FL", "FR"), ("RL", "RR")):
        for part in b2.PARTS:
            one, other = (mass.body(f"{leg}_{part}").xipos for leg in (left, right))
            np.testing.assert_allclose(one, other * [1.0, -1.0, 1.0], atol=1e-7)


def test_joints_have_the_limits_of_the_urdf(model):
    expected = {"hip": (-0.87, 0.87, 200.0), "thigh": (-0.94, 4.69, 200.0), "calf": (-2.82, -0.43, 320.0)}
    for index, name in enumerate(b2.JOINTS):
        low, high, torque = expected[name.split("_")[1]]
        np.testing.assert_allclose(model.joint(name).range, (low, high))
        np.testing.assert_allclose(model.actuator_forcerange[index], (-torque, torque))
        assert model.actuator_trnid[index, 0] == model.joint(name).id


def test_the_default_pose_puts_the_trunk_at_the_height_of_the_formula(model):
    data = mujoco.MjData(model)
    data.qpos[3], data.qpos[7:] = 1.0, standing_pose()[0]
    mujoco.mj_forward(model, data)
    lowest = data.geom("FL_foot").xpos[2] - b2.FOOT_RADIUS
    assert -lowest == pytest.approx(0.35 * np.cos(0.8) + 0.35 * np.cos(-0.7) + 0.032, abs=1e-6)
    assert -lowest == pytest.approx(b2.STAND_HEIGHT, abs=1e-4)


def test_it_stands_for_ten_seconds_within_five_centimetres(on_floor):
    data = standing(on_floor)
    moved = 0.0
    for _ in range(2500):
        mujoco.mj_step(on_floor, data)
        moved = max(moved, float(np.linalg.norm(data.qpos[:3] - [0.0, 0.0, b2.STAND_HEIGHT])))
    assert moved < 0.01
    assert not np.isnan(data.qpos).any()


def test_only_feet_touch_the_ground_and_only_the_bumpers_walls(model):
    touching = {model.geom(k).name: model.geom_conaffinity[k] for k in range(model.ngeom)}
    assert touching == {"trunk": 0, **dict.fromkeys(b2.BUMPERS, 8), **{f"{leg}_foot": 4 for leg in b2.LEGS}}
    assert (model.geom_contype == 0).all()


def test_the_friction_that_is_drawn_is_that_of_the_feet_and_of_nothing_else():
    engine = Engine(B2)
    build = Build(jnp.asarray(0.33), jnp.ones(()), jnp.zeros(3), jnp.ones(12), jnp.ones(12))
    host, friction = engine.host, np.asarray(engine.model_of(build, engine.model).pair_friction[:, 0])
    touching = [{host.geom(g).name for g in pair} for pair in zip(host.pair_geom1, host.pair_geom2, strict=True)]
    feet = np.array([bool(names & set(engine.machine.treads)) for names in touching])
    assert feet.sum() == N_PLANES * 4
    assert (~feet).sum() == 2
    np.testing.assert_allclose(friction[feet], 0.33, rtol=1e-6)
    np.testing.assert_array_equal(friction[~feet], host.pair_friction[~feet, 0].astype(np.float32))


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
