"""One control period of the robot on its window of track, in MJX."""

import contextlib
import dataclasses
import io
from functools import cached_property

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from subterra_jax.b2 import constants as b2
from subterra_jax.b2.kinematics import inverse, rotate
from subterra_jax.b2.model import add_stand, robot_spec
from subterra_jax.b2.params import Body, Build, Surroundings
from subterra_jax.b2.track import WindowConfig, add_window

with contextlib.redirect_stdout(io.StringIO()):  # it prints that Warp, which is not used here, is missing
    from mujoco import mjx

# The walls: a stiff spring with damper at either end of the trunk.
WALL_STIFFNESS, WALL_DAMPING = 2e4, 2e3  # N/m, N s/m
_BUMPER_X, BUMPER_RADIUS = 0.33, 0.225  # of two discs that make up the robot's envelope in plan, m
BUMPERS = ((_BUMPER_X, 0.0, 0.0), (-_BUMPER_X, 0.0, 0.0))


@dataclasses.dataclass(frozen=True, eq=False)
class Physics:
    """The compiled robot. It is compared by identity, so that bound methods can be jitted."""

    window: WindowConfig = dataclasses.field(default_factory=WindowConfig)  # the part of the track that can be touched
    substeps: int = 5  # steps of physics in a control period
    iterations: int = 1  # iterations of the solver in each step
    ls_iterations: int = 5  # iterations of its line search

    @property
    def period(self) -> float:
        """Control period, s."""
        return self.substeps * b2.TIMESTEP

    def spec(self) -> mujoco.MjSpec:
        """Return the MJCF of the robot on its window of track."""
        spec = robot_spec()
        add_window(spec, self.window)
        spec.option.iterations, spec.option.ls_iterations = self.iterations, self.ls_iterations
        add_stand(spec)
        return spec

    @cached_property
    def host(self) -> mujoco.MjModel:
        """The model on the CPU."""
        return self.spec().compile()

    @cached_property
    def model(self) -> mjx.Model:
        """The model on the device."""
        with jax.ensure_compile_time_eval():
            return mjx.put_model(self.host, impl="jax")

    @cached_property
    def blank(self) -> mjx.Data:
        """Empty data of the model."""
        with jax.ensure_compile_time_eval():
            return mjx.make_data(self.host, impl="jax")

    @cached_property
    def _feet(self) -> np.ndarray:
        return np.array([self.host.geom(f"{leg}_foot").id for leg in b2.LEGS])

    @cached_property
    def _trunk(self) -> int:
        return int(self.host.body("base_link").id)

    def model_of(self, build: Build) -> mjx.Model:
        """Return the model of one robot."""
        model = self.model
        base = model.body_ipos[self._trunk]
        gain = model.actuator_gainprm.at[:, 0].multiply(build.stiffness)
        bias = model.actuator_biasprm.at[:, 1].multiply(build.stiffness).at[:, 2].multiply(build.damping)
        return model.replace(
            geom_friction=model.geom_friction.at[self._feet, 0].set(build.friction),
            body_mass=model.body_mass * build.mass,
            body_inertia=model.body_inertia * build.mass,
            body_ipos=model.body_ipos.at[self._trunk].set(base + build.shift),
            actuator_gainprm=gain,
            actuator_biasprm=bias,
        )

    def run(self, body: Body, targets: Float[Array, "12"], around: Surroundings, build: Build) -> Body:
        """Advances the robot by one control period.

        Args:
            body: State before the period.
            targets: Targets of the servos, rad; the servos clip them to the joints' ranges.
            around: Ground and walls.
            build: Properties of the robot.
        """
        model = self.model_of(build)
        positions, quaternions = around.ground
        data = self.blank.replace(ctrl=targets, mocap_pos=positions, mocap_quat=quaternions)

        def substep(now: Body, _: None) -> tuple[Body, None]:
            pushed = data.xfrc_applied.at[self._trunk].set(wall_wrench(now, around))
            after = mjx.step(
                model,
                data.replace(qpos=now.qpos, qvel=now.qvel, qacc_warmstart=now.warmstart, xfrc_applied=pushed),
            )
            return Body(after.qpos, after.qvel, after.qacc_warmstart), None

        # A GPU would round the products inside MJX to TF32, three digits.
        with jax.default_matmul_precision("highest"):
            return lax.scan(substep, body, None, length=self.substeps)[0]


def wall_wrench(body: Body, around: Surroundings) -> Float[Array, "6"]:
    """Computes the force (N) and torque (N m, about the trunk's centre of mass) of the smooth walls on the robot.

    They act on two discs, one at either end of the trunk, which together are the robot's envelope. Both are zero
    where no wall is touched.
    """
    force_sum, torque_sum = jnp.zeros(3), jnp.zeros(3)
    back = inverse(around.quaternion)
    left = rotate(around.quaternion, jnp.array([0.0, 1.0, 0.0]))
    spin = rotate(body.qpos[3:7], body.qvel[3:6])
    for bumper in BUMPERS:
        arm = rotate(body.qpos[3:7], jnp.array(bumper))
        lateral = rotate(back, body.qpos[:3] + arm)[1]
        speed = rotate(back, body.qvel[:3] + _cross(spin, arm))[1]
        depth = jnp.abs(lateral) + BUMPER_RADIUS - around.half_width
        outward = jnp.sign(lateral)
        push = jnp.clip(WALL_STIFFNESS * depth + WALL_DAMPING * outward * speed, 0.0, 1e4)
        force = -outward * jnp.where(depth > 0.0, push, 0.0) * left
        force_sum, torque_sum = force_sum + force, torque_sum + _cross(arm, force)
    return jnp.concatenate([force_sum, torque_sum])


def _cross(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
