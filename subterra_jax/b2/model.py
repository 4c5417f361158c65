"""The B2 as MJCF, written from its constants: position servos, bumpers that touch walls and feet on the ground."""

import mujoco

from subterra_jax.b2 import constants as b2
from subterra_jax.b2.shape import shape_of
from subterra_jax.host.rover import GROUND, LOW_WALL
from subterra_jax.physics.engine import Machine, set_options

_BOX, _SPHERE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE
_ROBOT, _HIDDEN = 2, 3  # groups of what is drawn and of what MuJoCo does not draw unless asked to
_SHELL, _LIMB = (0.30, 0.31, 0.33, 1.0), (0.16, 0.16, 0.17, 1.0)


def robot_spec() -> mujoco.MjSpec:
    """Builds the robot alone, on a free joint with the trunk's middle at the origin."""
    spec = mujoco.MjSpec()
    spec.modelname = "b2"
    spec.compiler.degree = False
    set_options(spec)
    trunk = spec.worldbody.add_body(name="base_link")
    trunk.add_freejoint(name="base")
    _set_inertia(trunk, b2.TRUNK)
    _add_trunk_geom(trunk)
    for leg in b2.LEGS:
        _add_leg(spec, trunk, leg)
    return spec


def dress(spec: mujoco.MjSpec) -> None:
    """Adds the robot's looks for pictures, as meshes that touch and weigh nothing, and hides its primitives.

    Physics never sees this model, and would give the same bits with it.
    """
    for name in ("base_link", *(f"{leg}_{part}" for leg in b2.LEGS for part in b2.PARTS)):
        body = spec.body(name)
        for geom in body.geoms:
            geom.group = _HIDDEN
        for k, part in enumerate(shape_of(name)):
            own = f"{name} {k}"
            mesh = spec.add_mesh(name=own, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
            mesh.uservert, mesh.userface = part.vertices.ravel().tolist(), part.faces.ravel().tolist()
            body.add_geom(
                name=own, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=own, mass=0.0, contype=0, conaffinity=0,
                group=_ROBOT, rgba=(*part.colour, 1.0),
            )  # fmt: skip


def _set_inertia(body: mujoco.MjsBody, inertial: b2.Inertial) -> None:
    body.mass, body.ipos, body.fullinertia = inertial.mass, inertial.com, inertial.inertia
    body.explicitinertial = True


def _add_leg(spec: mujoco.MjSpec, trunk: mujoco.MjsBody, leg: str) -> None:
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
    body.add_site(name=f"{leg}_foot", pos=(0.0, 0.0, -b2.LINK), size=(0.01,) * 3, group=4)
    body.add_geom(
        name=f"{leg}_foot", type=_SPHERE, pos=(0.0, 0.0, -b2.LINK), size=(b2.FOOT_RADIUS, 0.0, 0.0), mass=0.0,
        contype=0, conaffinity=GROUND, condim=3, priority=1, friction=(b2.FOOT_FRICTION, 0.005, 0.0001),
        group=_ROBOT, rgba=_LIMB,
    )  # fmt: skip


def _add_joint(spec: mujoco.MjSpec, body: mujoco.MjsBody, leg: str, part: str) -> None:
    joint, name = b2.JOINT[part], f"{leg}_{part}"
    body.add_joint(
        name=f"{name}_joint", type=mujoco.mjtJoint.mjJNT_HINGE, axis=joint.axis, range=(joint.low, joint.high),
        limited=mujoco.mjtLimited.mjLIMITED_TRUE, armature=joint.armature,
    )  # fmt: skip
    servo = spec.add_actuator(name=name, target=f"{name}_joint", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=joint.stiffness, kv=joint.damping)
    servo.forcerange, servo.forcelimited = (-joint.torque, joint.torque), mujoco.mjtLimited.mjLIMITED_TRUE
    servo.ctrlrange, servo.ctrllimited = (joint.low, joint.high), mujoco.mjtLimited.mjLIMITED_TRUE


def _add_trunk_geom(trunk: mujoco.MjsBody) -> None:
    """Adds the collision box of the URDF, for looks, and the bumpers, which alone touch anything."""
    size = (0.25, 0.14, 0.075)
    trunk.add_geom(name="trunk", type=_BOX, size=size, mass=0.0, contype=0, conaffinity=0, group=_ROBOT, rgba=_SHELL)
    for name, end in zip(b2.BUMPERS, (1.0, -1.0), strict=True):
        trunk.add_geom(
            name=name, type=_SPHERE, pos=(end * b2.BUMPER_X, 0.0, 0.0), size=(b2.BUMPER_RADIUS, 0.0, 0.0), mass=0.0,
            contype=0, conaffinity=LOW_WALL, condim=1, priority=1, group=_HIDDEN,
        )  # fmt: skip


B2 = Machine(
    "B2", b2.ENVELOPE[1], robot_spec, "base_link", tuple(f"{leg}_foot" for leg in b2.LEGS), b2.BUMPERS, dress=dress
)
