"""Pictures of a robot with mass, drawn by MuJoCo: in the scene in which it moves, or in the bore of its tunnel."""

from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from subterra_jax.physics.engine import PREFIX, Engine
from subterra_jax.physics.ground import Track
from subterra_jax.physics.stage import scene_world
from subterra_jax.pictures.camera import FollowCamera, TunnelChoice
from subterra_jax.pictures.stage import Stretch

_BEHIND, _PITCH_DEG, _ASIDE_DEG = 2.9, -15.0, 24.0  # of the point looked at: m, degrees, degrees
_AHEAD, _BELOW = 0.35, 0.1  # of the trunk, that point, m


class RobotView:
    """Draws a robot from behind, a little to one side.

    Args:
        engine: The engine with the robot.
        track: The ground of its tunnel.
        tunnel: The tunnel to draw where there is no scene.
        scene: File of the scene in which it moves, if there is one.
        width: Width of a picture, pixels.
        height: Height of a picture, pixels.
    """

    def __init__(
        self,
        engine: Engine,
        track: Track,
        tunnel: TunnelChoice,
        scene: Path | None = None,
        width: int = 480,
        height: int = 480,
    ):
        self._machine, self._track, self._choice, self._scene = engine.machine, track, tunnel, scene
        self._size, self._n_pose = (width, height), engine.alone.nq

    @cached_property
    def _camera(self) -> FollowCamera:
        # Drawn is a model of its own, which wears the robot's looks: physics has neither their meshes nor their cost.
        if self._scene is None:
            return FollowCamera(self._choice, *self._size, furnish=self._add_robot)
        spec = scene_world(self._scene)
        self._add_robot(spec, None)
        return FollowCamera(self._choice, *self._size, spec.compile())

    def picture(self, env: Any, params: Any, state: Any, obs: np.ndarray) -> np.ndarray:
        """Draw a state, `(height, width, 3)` uint8; see `pictures.views.View`.

        Raises:
            PictureError: There is no OpenGL.
        """
        ride = state.parts[env.motion.name] if hasattr(env, "motion") else state
        qpos = np.array(ride.body.qpos, np.float64)
        qpos[:3] += np.asarray(self._track.position[ride.anchor], np.float64)
        return self.draw(qpos)

    def draw(self, qpos: Float[np.ndarray, "n_qpos"]) -> np.ndarray:
        """Draw a robot at a pose in the tunnel frame; see `picture`."""
        ahead = np.zeros(3)
        mujoco.mju_rotVecQuat(ahead, np.array([1.0, 0.0, 0.0]), qpos[3:7])
        middle, camera = qpos[:3], self._camera
        if self._scene is None:
            camera.follow(0, middle, ahead)
        camera.data.qpos[: self._n_pose] = qpos
        mujoco.mj_kinematics(camera.model, camera.data)
        mujoco.mj_camlight(camera.model, camera.data)
        return camera.draw(
            target=middle + _AHEAD * ahead - np.array([0.0, 0.0, _BELOW]),
            lit=middle + 2.0 * ahead,
            distance=_BEHIND,
            azimuth=np.rad2deg(np.arctan2(ahead[1], ahead[0])) + _ASIDE_DEG,
            elevation=_PITCH_DEG,
        )

    def close(self) -> None:
        if "_camera" in self.__dict__:
            self._camera.close()

    def _add_robot(self, spec: mujoco.MjSpec, stretch: Stretch | None) -> None:
        robot = self._machine.spec()
        if self._machine.dress is not None:
            self._machine.dress(robot)
        spec.option, robot.option.timestep = robot.option, robot.option.timestep
        spec.attach(robot, prefix=PREFIX, frame=spec.worldbody.add_frame())
