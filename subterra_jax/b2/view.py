"""Pictures of a walking B2, drawn by MuJoCo: in the scene in which it walks, or on its window of track."""

import os
from typing import Any, NamedTuple

import mujoco
import numpy as np

from subterra_jax.b2.engine import MujocoPhysics, SceneSurroundings, rotate_vector
from subterra_jax.b2.params import Surroundings, WalkParams, WalkState
from subterra_jax.b2.walk import WalkEnv
from subterra_jax.host.errors import SubterraError

_MOST_LAMPS = 7  # OpenGL has eight lights, one of them the headlight
_BEHIND, _PITCH_DEG, _ASIDE_DEG, _AHEAD = 2.6, -16.0, 18.0, 0.6  # of the trunk: m, degrees, degrees, m
_AMBIENT, _DIFFUSE = 0.45, 0.55  # of the headlight, where a model has no lamps
_WALL_LENGTH, _WALL_HEIGHT = 8.0, 1.2  # half sizes of the two panels that stand for the walls of a tunnel, m
_WALL_COLOUR = np.array([0.62, 0.61, 0.58, 1.0], np.float32)


class PictureError(SubterraError):
    """MuJoCo cannot draw here."""


class Moment(NamedTuple):
    """Poses of the robot and of the window's mocap bodies, if any, in the model's coordinates."""

    qpos: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray

    @classmethod
    def from_data(cls, data: mujoco.MjData) -> "Moment":
        """Copies the poses from data."""
        return cls(data.qpos.copy(), data.mocap_pos.copy(), data.mocap_quat.copy())


class Camera:
    """Draws a robot from behind, a little to one side.

    Args:
        walk: The environment; its physics must be MuJoCo's own.
        params: Its params.
        width: Width of a picture, pixels.
        height: Height of a picture, pixels.

    Raises:
        PictureError: There is no OpenGL.
    """

    def __init__(self, walk: WalkEnv, params: WalkParams, width: int = 480, height: int = 480):
        assert isinstance(walk.physics, MujocoPhysics)
        self._physics, self._params = walk.physics, params
        model = walk.physics.bench.model
        frame = model.vis.global_
        frame.offwidth, frame.offheight = max(frame.offwidth, width), max(frame.offheight, height)
        if not model.nlight:
            model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = _AMBIENT, _DIFFUSE
        # Drawing must not change the solver's data.
        self._data = mujoco.MjData(model)
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        except (RuntimeError, AttributeError, ImportError, mujoco.FatalError) as cause:
            raise PictureError(
                f"MuJoCo cannot draw with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r}: {cause}; set it to egl, "
                "osmesa or glfw before anything imports mujoco"
            ) from cause

    def picture(self, state: WalkState, around: Surroundings) -> np.ndarray:
        """Draws one picture, `(height, width, 3)` uint8.

        Args:
            state: The robot.
            around: Ground and walls.
        """
        data = self._data
        data.qpos[:] = state.body.qpos
        if isinstance(around, SceneSurroundings):
            data.qpos[:3] += np.asarray(around.origin)
        else:
            data.mocap_pos[:], data.mocap_quat[:] = around.ground
        return self._draw(around)

    def snap(self, moment: "Moment", around: Surroundings) -> np.ndarray:
        """Draws one picture of a moment within a step, `(height, width, 3)` uint8.

        Args:
            moment: Poses of the robot and the window.
            around: Ground and walls at the end of that step.
        """
        data = self._data
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = moment.qpos, moment.position, moment.quaternion
        return self._draw(around)

    def _draw(self, around: Surroundings) -> np.ndarray:
        data, model = self._data, self._physics.bench.model
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        middle, ahead = data.qpos[:3].copy(), rotate_vector(data.qpos[3:7], np.array([1.0, 0.0, 0.0]))
        self._light(middle + 2.0 * ahead)
        camera = mujoco.MjvCamera()
        camera.type, camera.lookat[:] = mujoco.mjtCamera.mjCAMERA_FREE, middle + _AHEAD * ahead
        camera.distance, camera.elevation = _BEHIND, _PITCH_DEG
        camera.azimuth = np.rad2deg(np.arctan2(ahead[1], ahead[0])) + _ASIDE_DEG
        self._renderer.update_scene(data, camera)
        if not isinstance(around, SceneSurroundings):
            self._add_walls(around)
        return self._renderer.render().copy()

    def close(self) -> None:
        """Releases the renderer."""
        self._renderer.close()

    def _light(self, point: np.ndarray) -> None:
        """Switches on the lamps nearest to a point, and the others off."""
        model, distance = self._physics.bench.model, np.linalg.norm(self._data.light_xpos - point, axis=1)
        if len(distance):
            model.light_active[:] = distance <= np.sort(distance)[min(_MOST_LAMPS, len(distance)) - 1]

    def _add_walls(self, around: Surroundings) -> None:
        """Adds two panels where the smooth walls are, straight along the track."""
        scene: Any = self._renderer.scene
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, np.asarray(around.quaternion, np.float64))
        size = np.array([_WALL_LENGTH, 0.02, _WALL_HEIGHT])
        for side in (1.0, -1.0):
            middle = np.array([0.0, side * (float(around.half_width) + 0.02), _WALL_HEIGHT - 0.1])
            middle = rotate_vector(np.asarray(around.quaternion), middle)
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_BOX, size, middle, matrix, _WALL_COLOUR)
            scene.ngeom += 1
