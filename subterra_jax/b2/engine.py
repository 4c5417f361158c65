"""MuJoCo's own engine in place of MJX: the same robot on the same window of track, computed in C in double precision.

It stands where `Physics` stands, so that everything around it, from the servos' targets to the reward, is one and the
same code on both engines.
"""

import dataclasses
import threading
from collections.abc import Callable
from functools import cached_property
from typing import Any

import jax
import mujoco
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.b2 import constants as b2
from subterra_jax.b2 import physics
from subterra_jax.b2.physics import Body, Build, Physics, Surroundings

_SAFE = 0.8  # m; a trunk whose middle is this far from both walls cannot touch one within a control period


class Workbench:
    """One model with its data, on which robots are put in turn; a step depends on nothing that was there before.

    Args:
        model: A model with the robot and nothing else that moves.
        prefix: Of the robot's names in it.

    Attributes:
        model: The model.
        data: Its data.
        lock: Whoever puts a robot there holds it until it is taken.
        watch: Called with the data at the end of each control period: a film is made so. None by default.
    """

    def __init__(self, model: mujoco.MjModel, prefix: str = ""):
        self.model, self.data = model, mujoco.MjData(model)
        self.feet = np.array([model.geom(f"{prefix}{leg}_foot").id for leg in b2.LEGS])
        self.trunk = int(model.body(f"{prefix}base_link").id)
        self.bodies = slice(self.trunk, self.trunk + 1 + 3 * len(b2.LEGS))
        self._mass, self._inertia = model.body_mass.copy(), model.body_inertia.copy()
        self._middle = model.body_ipos[self.trunk].copy()
        self._gain, self._bias = model.actuator_gainprm.copy(), model.actuator_biasprm.copy()
        self.lock = threading.Lock()
        self.watch: Callable[[mujoco.MjData], None] | None = None

    def be(self, build: Build) -> None:
        """Makes the robot one that differs from its figures as `build` says."""
        model, bodies = self.model, self.bodies
        model.geom_friction[self.feet, 0] = build.friction
        model.body_mass[bodies] = self._mass[bodies] * build.mass
        model.body_inertia[bodies] = self._inertia[bodies] * build.mass
        model.body_ipos[self.trunk] = self._middle + build.shift
        model.actuator_gainprm[:, 0] = self._gain[:, 0] * build.stiffness
        model.actuator_biasprm[:, 1] = self._bias[:, 1] * build.stiffness
        model.actuator_biasprm[:, 2] = self._bias[:, 2] * build.damping

    def run(self, body: Body, targets: np.ndarray, around: Surroundings, build: Build, n_steps: int) -> Body:
        """Some steps of physics on the window of track.

        Args:
            body: Before.
            targets: Of the servos, rad.
            around: What can be touched.
            build: The robot.
            n_steps: How many.
        """
        data = self.data
        with self.lock:
            self.be(build)
            self.put(body, targets)
            data.mocap_pos[:], data.mocap_quat[:] = around.ground
            if far_from_walls(body.qpos, around):
                data.xfrc_applied[self.trunk] = 0.0
                mujoco.mj_step(self.model, data, n_steps)
            else:
                for _ in range(n_steps):
                    data.xfrc_applied[self.trunk] = wall_wrench(data.qpos, data.qvel, around)
                    mujoco.mj_step(self.model, data)
            return self.taken()

    def put(self, body: Body, targets: np.ndarray, origin: np.ndarray | float = 0.0) -> None:
        """Puts a robot there, its position from `origin` (m), and tells its servos where to go."""
        data = self.data
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = body.qpos, body.qvel, body.warmstart
        data.qpos[:3] += origin
        data.ctrl[:] = targets

    def taken(self, origin: np.ndarray | float = 0.0) -> Body:
        """The robot as it is now, its position from `origin`, m."""
        data = self.data
        if self.watch is not None:
            self.watch(data)
        qpos = data.qpos.copy()
        qpos[:3] -= origin
        return Body(*(part.astype(np.float32) for part in (qpos, data.qvel, data.qacc_warmstart)))


@dataclasses.dataclass(frozen=True, eq=False)
class MujocoPhysics(Physics):
    """`Physics` by MuJoCo in C, on the host: the robots of a batch one after another."""

    @cached_property
    def bench(self) -> Workbench:
        """The model and its data."""
        return Workbench(self.spec().compile())

    def run(self, body: Body, targets: Float[Array, "12"], around: Surroundings, build: Build) -> Body:
        """One control period; see `Physics.run`."""
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, np.float32), body)
        return jax.pure_callback(self.run_rows, shapes, body, targets, around, build, vmap_method="broadcast_all")

    def run_rows(self, body: Body, targets: Any, around: Surroundings, build: Build) -> Body:
        """Any number of robots for one control period; all arrays have the same leading axes."""
        leaves, structure = jax.tree.flatten((body, targets, around, build))
        batch = np.shape(body.qpos)[:-1]
        leaves = [np.asarray(leaf) for leaf in leaves]
        rows = [leaf.reshape(-1, *leaf.shape[len(batch) :]) for leaf in leaves]
        after = [self.run_one(*jax.tree.unflatten(structure, [row[k] for row in rows])) for k in range(len(rows[0]))]
        stacked: Any = [np.stack(part).reshape(*batch, -1) for part in zip(*map(_parts, after), strict=True)]
        return Body(*stacked)

    def run_one(self, body: Body, targets: np.ndarray, around: Surroundings, build: Build) -> Body:
        """One robot for one control period."""
        return self.bench.run(body, targets, around, build, self.substeps)


def _parts(body: Body) -> tuple[Any, Any, Any]:
    return body.qpos, body.qvel, body.warmstart


def far_from_walls(qpos: Any, around: Surroundings) -> bool:
    """Whether no wall can push the trunk within a control period."""
    lateral = turned(np.asarray(around.quaternion), qpos[:3], back=True)[1]
    return bool(abs(lateral) < around.half_width - _SAFE)


def wall_wrench(qpos: np.ndarray, qvel: np.ndarray, around: Surroundings) -> np.ndarray:
    """`physics.wall_wrench` in NumPy, `(6,)`: nothing of JAX may be called while JAX waits for the host."""
    track = np.asarray(around.quaternion, np.float64)
    left = turned(track, np.array([0.0, 1.0, 0.0]))
    spin = turned(qpos[3:7], qvel[3:6])
    wrench = np.zeros(6)
    for place in physics.BUMPERS:
        arm = turned(qpos[3:7], np.array(place))
        lateral = turned(track, qpos[:3] + arm, back=True)[1]
        speed = turned(track, qvel[:3] + np.cross(spin, arm), back=True)[1]
        deep, outward = abs(lateral) + physics.BUMPER_RADIUS - float(around.half_width), np.sign(lateral)
        push = np.clip(physics.WALL_STIFFNESS * deep + physics.WALL_DAMPING * outward * speed, 0.0, 1e4)
        force = -outward * (push if deep > 0.0 else 0.0) * left
        wrench += np.concatenate([force, np.cross(arm, force)])
    return wrench


def turned(quaternion: np.ndarray, vector: np.ndarray, back: bool = False) -> np.ndarray:
    """A vector of the turned frame in the frame outside; `back`, the other way."""
    w, axis = float(quaternion[0]), np.asarray(quaternion[1:], np.float64) * (-1.0 if back else 1.0)
    cross = np.cross(axis, vector)
    return vector + 2.0 * (w * cross + np.cross(axis, cross))
