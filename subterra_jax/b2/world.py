"""The B2 in a built scene as it is: `scene.xml` with the robot put in, all of its sleepers, rails and walls there."""

import dataclasses
from functools import cached_property
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.b2.engine import MujocoPhysics, Workbench
from subterra_jax.b2.model import robot_spec
from subterra_jax.b2.params import WalkParams, WalkState
from subterra_jax.b2.physics import Body, Build, Surroundings
from subterra_jax.b2.track import TrackError
from subterra_jax.b2.walk import WalkEnv

PREFIX = "b2/"  # of the robot's names in a scene
_SCOUT = "scout"  # the wheeled robot that a scene comes with
_ITERATIONS, _LINE_SEARCH = 10, 20  # of the solver: accuracy costs little on one robot


@struct.dataclass
class Placed(Surroundings):
    """`Surroundings`, and where they are.

    Attributes:
        origin: Of the anchor, tunnel frame, m.
    """

    origin: Float[Array, "3"] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class ScenePhysics(MujocoPhysics):
    """MuJoCo in C on a scene's own geometry. Feet touch what is GROUND there, the trunk what is LOW_WALL.

    Attributes:
        scene: The MJCF file.
    """

    scene: Path = Path("scene.xml")

    @cached_property
    def bench(self) -> Workbench:
        """The scene with the robot in it."""
        return Workbench(self.scene_spec().compile(), PREFIX)

    def scene_spec(self) -> mujoco.MjSpec:
        """The scene with the robot in it, as MJCF.

        Raises:
            TrackError: The scene cannot be read.
        """
        try:
            spec = mujoco.MjSpec.from_file(str(self.scene))
        except ValueError as cause:
            raise TrackError(f"{self.scene}: not a readable scene ({cause})") from cause
        if scout := spec.body(_SCOUT):
            spec.delete(scout)
        robot = robot_spec(self.robot)
        option, own = spec.option, robot.option
        option.timestep, option.integrator, option.cone = own.timestep, own.integrator, own.cone
        option.disableflags = own.disableflags
        # MuJoCo warns where the two differ when they are joined.
        option.iterations, option.ls_iterations = own.iterations, own.ls_iterations
        spec.attach(robot, prefix=PREFIX, frame=spec.worldbody.add_frame())
        option.iterations, option.ls_iterations = _ITERATIONS, _LINE_SEARCH
        return spec

    def run_one(self, body: Body, targets: np.ndarray, around: Surroundings, build: Build) -> Body:
        """One robot for one control period, in the scene's coordinates."""
        assert isinstance(around, Placed)
        bench, origin = self.bench, np.asarray(around.origin, np.float64)
        with bench.lock:
            bench.be(build)
            bench.put(body, targets, origin)
            mujoco.mj_step(bench.model, bench.data, self.substeps)
            return bench.taken(origin)


@dataclasses.dataclass(frozen=True, eq=False)
class SceneWalk(WalkEnv):
    """`WalkEnv` whose physics needs to know where in the scene the robot is."""

    @classmethod
    def of(cls, walk: WalkEnv, folder: Path, lining: str | None) -> "SceneWalk":
        """The same environment, in the scene of a folder; that with furniture where the lining is `furnished`.

        Raises:
            TrackError: The scene cannot be read.
        """
        file = folder / ("scene_furnished.xml" if lining == "furnished" else "scene.xml")
        if not file.is_file():
            raise TrackError(f"{file} is missing")
        own = {name: getattr(walk, name) for name in ("id", "driven", "privileged")}
        return cls(physics=ScenePhysics(robot=walk.physics.robot, scene=file), **own)

    def surroundings(self, state: WalkState, params: WalkParams) -> Placed:
        """What the robot may touch in the next control period, and where that is."""
        around: dict[str, Any] = vars(super().surroundings(state, params))
        return Placed(**around, origin=jnp.asarray(params.track.position[state.anchor]))
