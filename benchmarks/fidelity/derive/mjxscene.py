"""The released scene in MJX beside MuJoCo; its step is compiled once for each content of the scene."""

import io
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass

import jax
import mujoco
import numpy as np
from jaxtyping import Float

from benchmarks.fidelity.case import Case, until
from benchmarks.fidelity.derive import released
from benchmarks.fidelity.derive.released import of_released

with redirect_stdout(io.StringIO()):  # it prints that warp, which nothing here needs, is not installed
    from mujoco import mjx

_PLACES = 200
_STEPS = 100
_PUSH = (0.5, 0.3)  # m/s forwards, rad/s
_BY_WALL = 0.3  # m; how far from first contact the placements go either way
_LIFT = (-0.01, 0.02)  # m about where the robot stands at first


@dataclass(frozen=True)
class Stepper:
    """One compiled step.

    Attributes:
        step: From MJX data to MJX data.
        model: For MuJoCo.
        data: MJX data of the model's first pose.
    """

    step: Callable[[mjx.Data], mjx.Data]
    model: mujoco.MjModel
    data: mjx.Data

    def at(self, qpos: np.ndarray, qvel: np.ndarray) -> mjx.Data:
        """MJX data of a state."""
        return self.data.replace(qpos=jax.numpy.asarray(qpos), qvel=jax.numpy.asarray(qvel))


@until("PAR")
@of_released("scene")
def stepper(case: Case) -> Stepper:
    """Puts the scene on the device and compiles a step."""
    model = released.model(case)
    device = mjx.put_model(model)
    data = mjx.make_data(device)
    step = jax.jit(mjx.step).lower(device, data).compile()
    return Stepper(lambda state: step(device, state), model, data)


@of_released("scene")
def steps_finite(case: Case) -> bool:
    """Whether one step from the first pose gives finite numbers."""
    made = stepper(case)
    after = made.step(made.data)
    return bool(np.isfinite(np.asarray(after.qpos)).all() and np.isfinite(np.asarray(after.qvel)).all())


@of_released("scene", "tunnel", "mesh")
def contacts(case: Case) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Deepest contact of the robot at random places, by MuJoCo and by MJX, m; 0 where it touches nothing."""
    made = stepper(case)
    cpu = mujoco.MjData(made.model)
    ours, theirs = np.zeros(_PLACES), np.zeros(_PLACES)
    still = np.zeros(made.model.nv)
    for k, qpos in enumerate(_places(case, made.model)):
        cpu.qpos[:], cpu.qvel[:] = qpos, 0.0
        mujoco.mj_forward(made.model, cpu)
        # A step reports the contacts of the pose that it starts from.
        device = mjx.get_data(made.model, made.step(made.at(qpos, still)))
        ours[k], theirs[k] = (min(float(np.min(data.contact.dist, initial=0.0)), 0.0) for data in (cpu, device))
    return ours, theirs


def _places(case: Case, model: mujoco.MjModel) -> Float[np.ndarray, "k q"]:
    """Poses of the robot by either wall, from clear of it to a little inside, at random headings."""
    rng = case.rng("mjx_contact_parity")
    station, middle, left = released.along_axis(case, "mjx_contact_parity", _PLACES)
    adr = int(model.jnt_qposadr[model.body_jntadr[released.robot(model)]])
    first = model.qpos0[adr : adr + 3]
    with np.load(case.candidate.tunnel) as tunnel:
        half = np.interp(station, tunnel["station"], tunnel["half_width"])
        ground = np.interp(station, tunnel["station"], tunnel["elevation"])
        start = tunnel["elevation"][np.argmin(np.linalg.norm(tunnel["centre"] - first[:2], axis=1))]
    lateral = half - _robot_radius(model) + rng.uniform(-_BY_WALL, _BY_WALL, _PLACES)
    place = middle + (rng.choice([-1.0, 1.0], _PLACES) * lateral)[:, None] * left
    place[:, 2] = ground + first[2] - start + rng.uniform(*_LIFT, _PLACES)
    yaw = rng.uniform(-np.pi, np.pi, _PLACES)
    qpos = np.tile(model.qpos0, (_PLACES, 1))
    qpos[:, adr : adr + 3] = place
    zero = np.zeros_like(yaw)
    qpos[:, adr + 3 : adr + 7] = np.column_stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)])
    return qpos


def _robot_radius(model: mujoco.MjModel) -> float:
    """Largest horizontal reach of the robot's geoms from its origin, m."""
    body = released.robot(model)
    own = range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
    return float(max(np.hypot(*model.geom_pos[k, :2]) + model.geom_size[k, 0] for k in own))


@of_released("scene")
def divergence(case: Case) -> Float[np.ndarray, " k"]:
    """Distance between the robot's positions by MuJoCo and by MJX after each of 100 steps from one state, m."""
    made = stepper(case)
    body = released.robot(made.model)
    joint = made.model.body_jntadr[body]
    place, speed = int(made.model.jnt_qposadr[joint]), int(made.model.jnt_dofadr[joint])
    cpu = released.placed(made.model)
    cpu.qvel[speed : speed + 3] = _PUSH[0] * cpu.xmat[body].reshape(3, 3)[:, 0]
    cpu.qvel[speed + 5] = _PUSH[1]
    device = made.at(cpu.qpos.copy(), cpu.qvel.copy())
    gap = np.zeros(_STEPS)
    for k in range(_STEPS):
        mujoco.mj_step(made.model, cpu)
        device = made.step(device)
        gap[k] = np.linalg.norm(cpu.qpos[place : place + 3] - np.asarray(device.qpos)[place : place + 3])
    return gap
