"""The B2 as MJCF, written from its constants: position servos, primitives, and feet that touch the ground."""

import dataclasses
import math
from pathlib import Path

import mujoco

from subterra_jax.b2 import constants as b2
from subterra_jax.b2.kinematics import standing_pose
from subterra_jax.b2.shape import shape_of
from subterra_jax.host.errors import SubterraError

_BOX, _SPHERE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE
_CAPSULE, _CYLINDER = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER
_ROBOT, _HIDDEN = 2, 3  # groups of what is drawn and of what MuJoCo does not draw unless asked to
_SHELL, _LIMB = (0.30, 0.31, 0.33, 1.0), (0.16, 0.16, 0.17, 1.0)
_MESH_ENDINGS = (".obj", ".stl")


class RobotError(SubterraError):
    """The robot cannot be built as asked."""


@dataclasses.dataclass(frozen=True)
class RobotConfig:
    """Settings of the robot's model.

    Attributes:
        timestep: Time step of the physics, s.
        foot_friction: Friction of the feet on any material. Rubber on concrete; the MJCFs say 0.4.
        meshes: Folder of the user's own meshes, for looks alone: `base_link.obj` (or `.stl`) and so on by body, in
            the bodies' frames, m. Bodies without one keep their primitives.
        body_touches: Contact bits of what the trunk touches. A fall is judged by the trunk's height, not by contact.
    """

    timestep: float = 0.004
    foot_friction: float = 0.8
    meshes: Path | None = None
    body_touches: int = b2.LOW_WALL


def robot_spec(config: RobotConfig | None = None) -> mujoco.MjSpec:
    """Builds the robot alone, on a free joint with the trunk's middle at the origin.

    Args:
        config: Settings of the model; the defaults if left out.

    Raises:
        RobotError: The folder of meshes holds no mesh of the robot.
    """
    config = config or RobotConfig()
    spec = mujoco.MjSpec()
    spec.modelname = "b2"
    spec.compiler.degree = False
    _set_options(spec, config.timestep)
    trunk = spec.worldbody.add_body(name="base_link")
    trunk.add_freejoint(name="base")
    _set_inertia(trunk, b2.TRUNK)
    _add_trunk_geoms(trunk, config.body_touches)
    for leg in b2.LEGS:
        _add_leg(spec, trunk, leg, config)
    sensors = {"gyro": mujoco.mjtSensor.mjSENS_GYRO, "accelerometer": mujoco.mjtSensor.mjSENS_ACCELEROMETER}
    for name, kind in sensors.items():
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="imu")
    if config.meshes is not None:
        _add_meshes(spec, config.meshes)
    return spec


def add_stand(spec: mujoco.MjSpec) -> None:
    """Adds the key frame `stand`: the default pose on a ground at z = 0, with the targets that hold it.

    Call this last: a key frame has the sizes of the model at that moment.
    """
    pose, hold = standing_pose()
    spec.add_key(name="stand", qpos=[0.0, 0.0, b2.STAND_HEIGHT, 1.0, 0.0, 0.0, 0.0, *pose.tolist()], ctrl=hold.tolist())


def dress(spec: mujoco.MjSpec, prefix: str = "") -> None:
    """Adds the robot's looks for pictures, as meshes that touch and weigh nothing, and hides its primitives.

    Bodies with a mesh of the user's keep that. Physics never sees this model, and would give the same bits with it.

    Args:
        spec: A model with the robot in it.
        prefix: Prefix of the robot's names.
    """
    for name in ("base_link", *(f"{leg}_{part}" for leg in b2.LEGS for part in b2.PARTS)):
        body = spec.body(f"{prefix}{name}")
        if any(geom.type == mujoco.mjtGeom.mjGEOM_MESH for geom in body.geoms):
            continue
        for geom in body.geoms:
            geom.group = _HIDDEN
        for k, part in enumerate(shape_of(name)):
            own = f"{prefix}{name} {k}"
            mesh = spec.add_mesh(name=own, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
            mesh.uservert, mesh.userface = part.vertices.ravel().tolist(), part.faces.ravel().tolist()
            body.add_geom(
                name=own, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=own, mass=0.0, contype=0, conaffinity=0,
                group=_ROBOT, rgba=(*part.colour, 1.0),
            )  # fmt: skip


def _set_options(spec: mujoco.MjSpec, timestep: float) -> None:
    """Sets one Newton iteration with a short line search, warm-started: enough for contacts of the feet."""
    option = spec.option
    option.timestep, option.iterations, option.ls_iterations = timestep, 1, 5
    option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtCone.mjCONE_PYRAMIDAL
    # The servos damp within the torque limit: an implicit step would not help.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP


def _set_inertia(body: mujoco.MjsBody, inertial: b2.Inertial) -> None:
    """Sets mass and inertia of a body."""
    body.mass, body.ipos, body.fullinertia = inertial.mass, inertial.com, inertial.inertia
    body.explicitinertial = True


def _add_leg(spec: mujoco.MjSpec, trunk: mujoco.MjsBody, leg: str, config: RobotConfig) -> None:
    """Adds the three bodies of a leg, and its foot."""
    side, end = (1.0 if leg[1] == "L" else -1.0), (1.0 if leg[0] == "F" else -1.0)
    offset = {
        "hip": (end * b2.HIP_X, side * b2.HIP_Y, 0.0),
        "thigh": (0.0, side * b2.THIGH_Y, 0.0),
        "calf": (0.0, 0.0, -b2.LINK),
    }
    body = trunk
    for part in b2.PARTS:
        body = body.add_body(name=f"{leg}_{part}", pos=offset[part])
        _set_inertia(body, b2.inertial(leg, part))
        _add_joint(spec, body, leg, part)
        _add_limb_geoms(body, part, side)
    body.add_site(name=f"{leg}_foot", pos=(0.0, 0.0, -b2.LINK), size=(0.01,) * 3, group=4)
    body.add_geom(
        name=f"{leg}_foot", type=_SPHERE, pos=(0.0, 0.0, -b2.LINK), size=(b2.FOOT_RADIUS, 0.0, 0.0), mass=0.0,
        contype=0, conaffinity=b2.GROUND, condim=3, priority=1, friction=(config.foot_friction, 0.005, 0.0001),
        group=_ROBOT, rgba=_LIMB,
    )  # fmt: skip


def _add_joint(spec: mujoco.MjSpec, body: mujoco.MjsBody, leg: str, part: str) -> None:
    """Adds a hinge and its position servo."""
    joint, name = b2.JOINT[part], f"{leg}_{part}"
    body.add_joint(
        name=f"{name}_joint", type=mujoco.mjtJoint.mjJNT_HINGE, axis=joint.axis, range=(joint.low, joint.high),
        limited=mujoco.mjtLimited.mjLIMITED_TRUE, armature=joint.armature,
    )  # fmt: skip
    servo = spec.add_actuator(name=name, target=f"{name}_joint", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=joint.stiffness, kv=joint.damping)
    servo.forcerange, servo.forcelimited = (-joint.torque, joint.torque), mujoco.mjtLimited.mjLIMITED_TRUE
    servo.ctrlrange, servo.ctrllimited = (joint.low, joint.high), mujoco.mjtLimited.mjLIMITED_TRUE


def _add_trunk_geoms(trunk: mujoco.MjsBody, touches: int) -> None:
    """Adds the URDF's collision primitives; only the trunk's box touches anything."""
    look = {"mass": 0.0, "contype": 0, "group": _ROBOT}
    trunk.add_geom(name="trunk", type=_BOX, size=(0.25, 0.14, 0.075), conaffinity=touches, rgba=_SHELL, **look)
    for name, x, half in (("head", 0.41, 0.02), ("tail", -0.405, 0.0125)):
        trunk.add_geom(
            name=name, type=_BOX, pos=(x, 0.0, 0.005), size=(half, 0.06, 0.07), conaffinity=0, rgba=_LIMB, **look
        )
    # The frame lies 2 cm above the middle of the housing.
    housing = (*b2.LIDAR[:2], b2.LIDAR[2] - 0.02)
    trunk.add_geom(
        name="lidar", type=_CYLINDER, pos=housing, size=(0.076, 0.08, 0.0), conaffinity=0, rgba=_LIMB, **look
    )
    for name, pos in (("imu", b2.IMU), ("lidar", b2.LIDAR)):
        trunk.add_site(name=name, pos=pos, size=(0.01,) * 3, group=4)


def _add_limb_geoms(body: mujoco.MjsBody, part: str, side: float) -> None:
    """Adds capsules in place of the URDF's boxes, for looks alone."""
    look = {"mass": 0.0, "contype": 0, "conaffinity": 0, "group": _ROBOT, "rgba": _LIMB}
    if part == "hip":
        quarter = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
        body.add_geom(type=_CYLINDER, pos=(0.0, 0.12 * side, 0.0), quat=quarter, size=(0.07, 0.025, 0.0), **look)
    elif part == "thigh":
        ends = (-0.03, 0.0, -0.03, -0.03, 0.0, -0.32)
        body.add_geom(type=_CAPSULE, fromto=ends, size=(0.03, 0.0, 0.0), **{**look, "rgba": _SHELL})
    else:
        for ends in ((0.0, 0.0, 0.0, 0.036, 0.0, -0.2), (0.036, 0.0, -0.2, 0.01, 0.0, -0.33)):
            body.add_geom(type=_CAPSULE, fromto=ends, size=(0.015, 0.0, 0.0), **look)


def _add_meshes(spec: mujoco.MjSpec, folder: Path) -> None:
    """Adds the user's meshes; bodies that have one hide their primitives."""
    count = 0
    for body in spec.bodies[1:]:
        files = [folder / f"{body.name}{ending}" for ending in _MESH_ENDINGS]
        file = next((path for path in files if path.is_file()), None)
        if file is None:
            continue
        count += 1
        for geom in body.geoms:
            geom.rgba = (*geom.rgba[:3], 0.0)
        spec.add_mesh(name=body.name, file=str(file.resolve()), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=body.name, mass=0.0, contype=0, conaffinity=0, group=_ROBOT
        )
    if not count:
        raise RobotError(f"{folder}: no mesh of the robot; they are looked for as base_link.obj, FL_hip.stl and so on")
