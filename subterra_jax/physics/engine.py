"""One engine for robots that roll or walk: a control period in MJX on the window of ground, or in MuJoCo's own C."""

import contextlib
import copy
import dataclasses
import io
import threading
from collections.abc import Callable
from functools import cached_property
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Float

from subterra_jax.physics.ground import N_PLANES, Window, touched_planes
from subterra_jax.physics.rotations import upright

with contextlib.redirect_stdout(io.StringIO()):  # it prints that Warp is missing
    from mujoco import mjx

TIMESTEP = 0.004  # of the physics, s
PREFIX = "robot/"  # of the robot's names in a scene
_ITERATIONS, _LINE_SEARCH = 10, 20  # of the solver in C: accuracy costs little on one robot


def set_options(spec: mujoco.MjSpec) -> None:
    """Set one Newton iteration with a short line search, warm-started: enough for the contacts of one robot."""
    option = spec.option
    option.timestep, option.iterations, option.ls_iterations = TIMESTEP, 1, 5
    option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtCone.mjCONE_PYRAMIDAL
    # No second factorisation for damping: servos damp within their torque limit, or in the inertia of the joint.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP


@struct.dataclass
class Body:
    """State of the physics; positions from the anchor."""

    qpos: Float[Array, "n_qpos"]  # trunk's position (m) and quaternion, joint angles (rad)
    # trunk's velocity (m/s, world axes) and rates (rad/s, its own axes), joint speeds (rad/s)
    qvel: Float[Array, "n_qvel"]
    warmstart: Float[Array, "n_qvel"]  # accelerations of the last step, from which the solver starts
    # states of actuators that lag behind their controls; none by default
    act: Float[Array, "n_act"] = dataclasses.field(default_factory=lambda: jnp.zeros(0))


@struct.dataclass
class Build:
    """Properties of one robot, as drawn by domain randomisation."""

    friction: Float[Array, ""]  # friction of feet or wheels
    mass: Float[Array, ""]  # factor on every mass and inertia
    shift: Float[Array, "3"]  # shift of the trunk's centre of mass, m
    stiffness: Float[Array, "n_servos"]  # factor on each servo's stiffness
    damping: Float[Array, "n_servos"]  # factor on each servo's damping


@dataclasses.dataclass(frozen=True)
class Machine:
    """A robot for the engine. Its spec holds it alone, on a free joint."""

    name: str  # what it is called in sentences
    width: float  # its width, m
    spec: Callable[[], mujoco.MjSpec]  # makes its MJCF
    trunk: str  # the body on the free joint
    treads: tuple[str, ...]  # balls that touch the ground
    bumpers: tuple[str, ...]  # balls on the trunk that touch walls
    half_width: float | None = None  # half the width of wheels in the treads, on whose z axes they turn, m; None: balls
    dress: Callable[[mujoco.MjSpec], None] | None = None  # adds looks for pictures; None where the spec has them


@dataclasses.dataclass(frozen=True, eq=False)
class Engine:
    """A robot in MJX, thousands at once. It is compared by identity, so that bound methods can be jitted.

    Attributes:
        machine: The robot.
        substeps: Steps of physics in a control period.
    """

    machine: Machine
    substeps: int = 5

    @property
    def period(self) -> float:
        """Control period, s."""
        return self.substeps * TIMESTEP

    @cached_property
    def alone(self) -> mujoco.MjModel:
        """The robot without a ground."""
        return self.machine.spec().compile()

    @cached_property
    def bumpers(self) -> Float[np.ndarray, "n 3"]:
        """Places of the bumpers on the trunk, m."""
        return self.alone.geom_pos[self._ids(self.alone, self.machine.bumpers)]

    @cached_property
    def reach(self) -> float:
        """Radius of the bumpers, m: a nearer wall is touched."""
        return float(self.alone.geom(self.machine.bumpers[0]).size[0])

    @cached_property
    def host(self) -> mujoco.MjModel:
        """The robot with a plane for each contact that it may have."""
        spec = self.machine.spec()
        for name in (*self.machine.treads, *self.machine.bumpers):
            geom = spec.geom(name)
            for k in range(N_PLANES if name in self.machine.treads else 1):
                plane = spec.worldbody.add_body(name=f"{name} {k}", mocap=True)
                plane.add_geom(
                    name=f"{name} {k}", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1.0, 1.0, 1.0), contype=0, conaffinity=0
                )
                mu = geom.friction
                spec.add_pair(
                    geomname1=f"{name} {k}", geomname2=name, condim=geom.condim,
                    friction=(mu[0], mu[0], mu[1], mu[2], mu[2]), solref=geom.solref, solimp=geom.solimp,
                )  # fmt: skip
        return spec.compile()

    @cached_property
    def model(self) -> mjx.Model:
        """`host` on the device."""
        with jax.ensure_compile_time_eval():
            return mjx.put_model(self.host, impl="jax")

    @cached_property
    def blank(self) -> mjx.Data:
        """Empty data of the model."""
        with jax.ensure_compile_time_eval():
            return mjx.make_data(self.host, impl="jax")

    @staticmethod
    def _ids(model: mujoco.MjModel, names: tuple[str, ...], prefix: str = "") -> np.ndarray:
        return np.array([model.geom(prefix + name).id for name in names])

    def model_of(self, build: Build | None, model: mjx.Model) -> mjx.Model:
        """Return the model of one robot, from that of the robot as it is, which stays without a build."""
        if build is None:
            return model
        trunk, treads = self.host.body(self.machine.trunk).id, self._ids(self.host, self.machine.treads)
        pairs = np.flatnonzero(np.isin(self.host.pair_geom1, treads) | np.isin(self.host.pair_geom2, treads))
        bias = model.actuator_biasprm.at[:, 1].multiply(build.stiffness).at[:, 2].multiply(build.damping)
        return model.replace(
            pair_friction=model.pair_friction.at[pairs, :2].set(build.friction),
            body_mass=model.body_mass * build.mass,
            body_inertia=model.body_inertia * build.mass,
            body_ipos=model.body_ipos.at[trunk].set(model.body_ipos[trunk] + build.shift),
            actuator_gainprm=model.actuator_gainprm.at[:, 0].multiply(build.stiffness),
            actuator_biasprm=bias,
        )

    def run(self, body: Body, control: Float[Array, "n_servos"], window: Window, build: Build | None = None) -> Body:
        """Advance the robot by one control period.

        Args:
            body: State before the period.
            control: Targets of the servos; they clip them to their ranges.
            window: Ground and walls.
            build: Properties of the robot; None for those of its model.
        """
        model, data = self.model_of(build, self.model), self.blank.replace(ctrl=control)

        def substep(now: Body, _: None) -> tuple[Body, None]:
            here = data.replace(qpos=now.qpos, qvel=now.qvel, qacc_warmstart=now.warmstart, act=now.act)
            after = mjx.step(model, self.on_ground(here, window))
            return Body(after.qpos, after.qvel, after.qacc_warmstart, after.act), None

        # A GPU would round the products inside MJX to TF32, three digits.
        with jax.default_matmul_precision("highest"):
            return lax.scan(substep, body, None, length=self.substeps)[0]

    def on_ground(self, data: mjx.Data, window: Window) -> mjx.Data:
        """Return data whose planes are where the robot may touch ground and walls."""
        treads = self._ids(self.host, self.machine.treads)
        placed = mjx.kinematics(self.model, self.blank.replace(qpos=data.qpos))
        centre, axle = placed.geom_xpos[treads], placed.geom_xmat[treads][:, :, 2]
        points, normals = jax.vmap(self._planes, (None, 0, 0))(window, centre, axle)
        turns = jax.vmap(upright)(jnp.concatenate([normals.reshape(-1, 3), window.away]))
        return data.replace(mocap_pos=jnp.concatenate([points.reshape(-1, 3), window.wall]), mocap_quat=turns)

    def _planes(self, window: Window, centre: Float[Array, "3"], axle: Float[Array, "3"]) -> tuple[Array, Array]:
        tread = self.alone.geom(self.machine.treads[0])
        return touched_planes(window, centre, axle, float(tread.size[0]), self.machine.half_width)


@dataclasses.dataclass(frozen=True, eq=False)
class MujocoEngine(Engine):
    """MuJoCo in C on the host, in a world with a ground of its own; it advances the robots of a batch in turn."""

    world: Callable[[], mujoco.MjSpec] = mujoco.MjSpec  # makes the MJCF of the world in the tunnel frame

    def placed(self) -> mujoco.MjSpec:
        """Return the world with the robot in it."""
        spec, robot = self.world(), self.machine.spec()
        spec.option = robot.option  # MuJoCo warns where the two differ when they are joined
        spec.attach(robot, prefix=PREFIX, frame=spec.worldbody.add_frame())
        spec.option.iterations, spec.option.ls_iterations = _ITERATIONS, _LINE_SEARCH
        # Thousands of geoms that stand still are placed once, not in every step: the same bits in a third of the time.
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
        return spec

    @cached_property
    def bench(self) -> "Workbench":
        return Workbench(self.placed().compile(), self.machine)

    def run(self, body: Body, control: Float[Array, "n_servos"], window: Window, build: Build | None = None) -> Body:
        """Advance the robot by one control period; see `Engine.run`. Of the window it takes the origin alone."""
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, np.float32), body)
        given = (body, control, window.origin, build)
        return jax.pure_callback(self.run_rows, shapes, *given, vmap_method="broadcast_all")

    def run_rows(self, body: Body, control: Any, origin: Any, build: Build | None) -> Body:
        """Advance any number of robots by one control period; all arrays have the same leading axes."""
        batch = np.shape(body.qpos)[:-1]
        n = int(np.prod(batch))
        in_rows = lambda leaf: np.asarray(leaf).reshape(n, *np.shape(leaf)[len(batch) :])  # noqa: E731
        rows: Any = jax.tree.map(in_rows, (body, control, origin, build))
        each: Any = (jax.tree.map(itemgetter(k), rows) for k in range(n))
        after = [self.bench.run(one[0], one[1], one[2], one[3], self.substeps) for one in each]
        return jax.tree.map(lambda *parts: np.reshape(parts, (*batch, *parts[0].shape)), *after)


class Workbench:
    """A world with one robot and nothing else that moves, used for many in turn; a step does not depend on the last."""

    def __init__(self, model: mujoco.MjModel, machine: Machine):
        self.model, self.data, self._usual = model, mujoco.MjData(model), copy.copy(model)
        self._lock = threading.Lock()  # held while a robot is advanced
        self._treads = Engine._ids(model, machine.treads, PREFIX)
        self._trunk = int(model.body(PREFIX + machine.trunk).id)
        self.watch: Callable[[mujoco.MjData], None] | None = None  # called at the end of each control period

    def apply_build(self, build: Build) -> None:
        model, usual = self.model, self._usual
        model.geom_friction[self._treads, 0] = build.friction
        model.body_mass[:] = usual.body_mass * build.mass
        model.body_inertia[:] = usual.body_inertia * build.mass
        model.body_ipos[self._trunk] = usual.body_ipos[self._trunk] + build.shift
        model.actuator_gainprm[:, 0] = usual.actuator_gainprm[:, 0] * build.stiffness
        model.actuator_biasprm[:, 1] = usual.actuator_biasprm[:, 1] * build.stiffness
        model.actuator_biasprm[:, 2] = usual.actuator_biasprm[:, 2] * build.damping

    def run(self, body: Body, control: np.ndarray, origin: np.ndarray, build: Build | None, n_steps: int) -> Body:
        """Advance a robot by some steps of physics; its position is from `origin`, in the tunnel frame, m."""
        data, anchor = self.data, np.asarray(origin, np.float64)
        with self._lock:
            if build is not None:
                self.apply_build(build)
            data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = body.qpos, body.qvel, body.warmstart
            data.qpos[:3] += anchor
            data.ctrl[:], data.act[:] = control, body.act
            mujoco.mj_step(self.model, data, n_steps)
            if self.watch is not None:
                self.watch(data)
            qpos = data.qpos.copy()
            qpos[:3] -= anchor
            return Body(*(part.astype(np.float32) for part in (qpos, data.qvel, data.qacc_warmstart, data.act)))
