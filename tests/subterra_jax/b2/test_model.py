"""The robot's MJCF against its figures."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from subterra_jax.b2 import constants as b2
from subterra_jax.b2.kinematics import standing_pose
from subterra_jax.b2.model import B2, robot_spec
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


def test_with_the_gains_of_the_isaac_configurations_it_collapses(on_floor):
    """Why the gains are ours: the figure that this rests on can be seen."""
    model = on_floor.__copy__()
    model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1], model.actuator_biasprm[:, 2] = 160.0, -160.0, -5.0
    data = standing(model)
    data.ctrl[:] = standing_pose()[0]
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert data.qpos[2] < 0.4


def test_only_feet_touch_the_ground_and_only_the_bumpers_walls(model):
    touching = {model.geom(k).name: model.geom_conaffinity[k] for k in range(model.ngeom)}
    assert touching == {"trunk": 0, **dict.fromkeys(b2.BUMPERS, 8), **{f"{leg}_foot": 4 for leg in b2.LEGS}}
    assert (model.geom_contype == 0).all()


def test_the_friction_that_is_drawn_is_that_of_the_feet_and_of_nothing_else():
    engine = Engine(B2)
    build = Build(jnp.asarray(0.33), jnp.ones(()), jnp.zeros(3), jnp.ones(12), jnp.ones(12))
    host, friction = engine.host, np.asarray(engine.model_of(build).pair_friction[:, 0])
    touching = [{host.geom(g).name for g in pair} for pair in zip(host.pair_geom1, host.pair_geom2, strict=True)]
    feet = np.array([bool(names & set(engine.machine.treads)) for names in touching])
    assert feet.sum() == N_PLANES * 4
    assert (~feet).sum() == 2
    np.testing.assert_allclose(friction[feet], 0.33, rtol=1e-6)
    np.testing.assert_array_equal(friction[~feet], host.pair_friction[~feet, 0].astype(np.float32))
