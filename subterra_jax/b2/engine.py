"""MuJoCo's own engine in place of MJX: the same robot, computed in C in double precision.

`MujocoPhysics` takes the place of `Physics` on the window of track, `ScenePhysics` in a whole built scene with all of
its sleepers, rails and walls. The rest, from the servo targets to the reward, is the same code on all engines.
"""

import dataclasses
import threading
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.b2 import constants as b2
from subterra_jax.b2 import physics
from subterra_jax.b2.model import robot_spec
from subterra_jax.b2.params import Body, Build, Surroundings
from subterra_jax.b2.physics import Physics
from subterra_jax.b2.track import TrackError
from subterra_jax.b2.walk import WalkEnv

PREFIX = "b2/"  # of the robot's names in a scene
_SCOUT = "scout"  # the wheeled robot that a scene comes with
_ITERATIONS, _LINE_SEARCH = 10, 20  # of the solver in a scene: accuracy costs little on one robot
_SAFE = 0.8  # m; a trunk whose middle is this far from both walls cannot touch one within a control period


class Workbench:
    """One model with its data, used for many robots in turn; a step does not depend on the robot before.

    Args:
        model: A model with the robot and nothing else that moves.
        prefix: Prefix of the robot's names in it.

    Attributes:
        model: The model.
        data: Its data.
        lock: Held while a robot is advanced.
        watch: Called at the end of each control period, as for a film, with the data and the position of its origin in
            the tunnel frame, m; `None` by default.
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
        self.watch: Callable[[mujoco.MjData, Any], None] | None = None

    def apply_build(self, build: Build) -> None:
        model, bodies = self.model, self.bodies
        model.geom_friction[self.feet, 0] = build.friction
        model.body_mass[bodies] = self._mass[bodies] * build.mass
        model.body_inertia[bodies] = self._inertia[bodies] * build.mass
        model.body_ipos[self.trunk] = self._middle + build.shift
        model.actuator_gainprm[:, 0] = self._gain[:, 0] * build.stiffness
        model.actuator_biasprm[:, 1] = self._bias[:, 1] * build.stiffness
        model.actuator_biasprm[:, 2] = self._bias[:, 2] * build.damping

    def run(
        self, body: Body, targets: np.ndarray, around: Surroundings, build: Build, n_steps: int, in_scene: bool = False
    ) -> Body:
        """Advances a robot.

        Args:
            body: State before, its position from the anchor.
            targets: Targets of the servos, rad.
            around: Ground and walls of the window of track; of them a scene takes the anchor alone.
            build: Properties of the robot.
            n_steps: Steps of physics.
            in_scene: Whether the model is a scene in its own coordinates.
        """
        data, anchor = self.data, np.asarray(around.origin, np.float64) if in_scene else np.zeros(3)
        with self.lock:
            self.apply_build(build)
            data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = body.qpos, body.qvel, body.warmstart
            data.qpos[:3] += anchor
            data.ctrl[:] = targets
            if not in_scene:
                data.mocap_pos[:], data.mocap_quat[:] = around.ground
            if in_scene or far_from_walls(body.qpos, around):
                data.xfrc_applied[self.trunk] = 0.0
                mujoco.mj_step(self.model, data, n_steps)
            else:
                for _ in range(n_steps):
                    data.xfrc_applied[self.trunk] = wall_wrench(data.qpos, data.qvel, around)
                    mujoco.mj_step(self.model, data)
            if self.watch is not None:
                self.watch(data, np.zeros(3) if in_scene else around.origin)
            qpos = data.qpos.copy()
            qpos[:3] -= anchor
            return Body(*(part.astype(np.float32) for part in (qpos, data.qvel, data.qacc_warmstart)))


@dataclasses.dataclass(frozen=True, eq=False)
class MujocoPhysics(Physics):
    """`Physics` by MuJoCo in C on the host; it computes the robots of a batch one after another."""

    @cached_property
    def bench(self) -> Workbench:
        return Workbench(self.spec().compile())

    def run(self, body: Body, targets: Float[Array, "12"], around: Surroundings, build: Build) -> Body:
        """Advances the robot by one control period; see `Physics.run`."""
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, np.float32), body)
        return jax.pure_callback(self.run_rows, shapes, body, targets, around, build, vmap_method="broadcast_all")

    def run_rows(self, body: Body, targets: Any, around: Surroundings, build: Build) -> Body:
        """Advances any number of robots by one control period; all arrays have the same leading axes."""
        leaves, structure = jax.tree.flatten((body, targets, around, build))
        batch = np.shape(body.qpos)[:-1]
        leaves = [np.asarray(leaf) for leaf in leaves]
        rows = [leaf.reshape(-1, *leaf.shape[len(batch) :]) for leaf in leaves]
        after = [self.run_one(*jax.tree.unflatten(structure, [row[k] for row in rows])) for k in range(len(rows[0]))]
        stacked: Any = [np.stack(part).reshape(*batch, -1) for part in zip(*map(jax.tree.leaves, after), strict=True)]
        return Body(*stacked)

    def run_one(self, body: Body, targets: np.ndarray, around: Surroundings, build: Build) -> Body:
        return self.bench.run(body, targets, around, build, self.substeps)


@dataclasses.dataclass(frozen=True, eq=False)
class ScenePhysics(MujocoPhysics):
    """MuJoCo in C on a scene's own geometry. Feet touch its GROUND geoms, the trunk its LOW_WALL geoms."""

    scene: Path = Path("scene.xml")  # the MJCF file

    @cached_property
    def bench(self) -> Workbench:
        return Workbench(self.scene_spec().compile(), PREFIX)

    def scene_spec(self) -> mujoco.MjSpec:
        """Return the MJCF of the scene with the robot in it.

        Raises:
            TrackError: The scene cannot be read.
        """
        try:
            spec = mujoco.MjSpec.from_file(str(self.scene))
        except ValueError as cause:
            raise TrackError(f"{self.scene}: not a readable scene ({cause})") from cause
        if scout := spec.body(_SCOUT):
            spec.delete(scout)
        robot = robot_spec()
        option, own = spec.option, robot.option
        option.timestep, option.integrator, option.cone = own.timestep, own.integrator, own.cone
        option.disableflags = own.disableflags
        # MuJoCo warns where the two differ when they are joined.
        option.iterations, option.ls_iterations = own.iterations, own.ls_iterations
        spec.attach(robot, prefix=PREFIX, frame=spec.worldbody.add_frame())
        option.iterations, option.ls_iterations = _ITERATIONS, _LINE_SEARCH
        return spec

    def run_one(self, body: Body, targets: np.ndarray, around: Surroundings, build: Build) -> Body:
        """Advances one robot by one control period, in the scene's coordinates."""
        return self.bench.run(body, targets, around, build, self.substeps, in_scene=True)


def walk_in_scene(walk: WalkEnv, folder: Path, lining: str | None) -> WalkEnv:
    """Return an environment moved into the scene of a folder: the one with furniture where the lining is `furnished`.

    Raises:
        TrackError: The scene cannot be read.
    """
    file = folder / ("scene_furnished.xml" if lining == "furnished" else "scene.xml")
    if not file.is_file():
        raise TrackError(f"{file} is missing")
    return dataclasses.replace(walk, physics=ScenePhysics(scene=file))


def far_from_walls(qpos: Any, around: Surroundings) -> bool:
    """Return whether no wall can push the trunk within a control period."""
    lateral = rotate_vector(np.asarray(around.quaternion), qpos[:3], back=True)[1]
    return bool(abs(lateral) < around.half_width - _SAFE)


def wall_wrench(qpos: np.ndarray, qvel: np.ndarray, around: Surroundings) -> np.ndarray:
    """Computes `physics.wall_wrench` in NumPy, `(6,)`: JAX must not be called while it waits for the host."""
    track = np.asarray(around.quaternion, np.float64)
    left = rotate_vector(track, np.array([0.0, 1.0, 0.0]))
    spin = rotate_vector(qpos[3:7], qvel[3:6])
    wrench = np.zeros(6)
    for bumper in physics.BUMPERS:
        arm = rotate_vector(qpos[3:7], np.array(bumper))
        lateral = rotate_vector(track, qpos[:3] + arm, back=True)[1]
        speed = rotate_vector(track, qvel[:3] + np.cross(spin, arm), back=True)[1]
        depth, outward = abs(lateral) + physics.BUMPER_RADIUS - float(around.half_width), np.sign(lateral)
        push = np.clip(physics.WALL_STIFFNESS * depth + physics.WALL_DAMPING * outward * speed, 0.0, 1e4)
        force = -outward * (push if depth > 0.0 else 0.0) * left
        wrench += np.concatenate([force, np.cross(arm, force)])
    return wrench


def rotate_vector(quaternion: np.ndarray, vector: np.ndarray, back: bool = False) -> np.ndarray:
    """Rotates a vector from the turned frame into the outer frame; with `back`, the other way."""
    w, axis = float(quaternion[0]), np.asarray(quaternion[1:], np.float64) * (-1.0 if back else 1.0)
    cross = np.cross(axis, vector)
    return vector + 2.0 * (w * cross + np.cross(axis, cross))
