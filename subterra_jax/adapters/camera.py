"""The scene as a camera behind the robot sees it, through MuJoCo."""

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from subterra_jax.env import TunnelEnv
from subterra_jax.host.errors import MissingLibraryError, SubterraError
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import load_tunnel, tunnel_of

if sys.platform == "linux" and "mujoco" not in sys.modules and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo reads it once, when it is imported

try:
    import mujoco
except ImportError as missing:
    raise MissingLibraryError(__name__, "mujoco") from missing

SIZE = 480
_BEHIND, _PITCH_DEG, _AHEAD = 4.0, -14.0, 1.0  # of the robot's middle: m, degrees, m
_LIT = 7  # OpenGL lights a scene with eight lights, the headlight among them
_BODY_HEIGHT = 0.55  # m above the ground, of the capsule's axis
_ORANGE = np.array([0.9, 0.42, 0.08, 1.0], np.float32)


class SceneError(SubterraError):
    """A scene cannot be read or drawn."""


class MujocoView:
    """Draws a scene folder with MuJoCo's renderer; the robot is a capsule as wide as its footprint.

    Args:
        scene: Folder that `scene.build` wrote, or one of its MJCF files (`scene_furnished.xml`).
    """

    def __init__(self, scene: Path):
        path = scene / "scene.xml" if scene.is_dir() else scene
        self.tunnel: Path | None = tunnel_of(scene)
        for needed in (path, self.tunnel):
            if not needed.is_file():
                raise SceneError(f"{scene} is no scene folder: {needed} is missing")
        try:
            self._model = mujoco.MjModel.from_xml_path(str(path))
        except ValueError as cause:
            raise SceneError(f"{path} cannot be loaded: {cause}") from cause
        self._plan: TunnelPlan = load_tunnel(self.tunnel)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        self._renderer: Any = None

    def picture(self, env: TunnelEnv, params: EnvParams, state: State, obs: np.ndarray) -> np.ndarray:
        """See `View`; the observation is not looked at."""
        if self._renderer is None:
            try:
                self._renderer = mujoco.Renderer(self._model, SIZE, SIZE)
            except (RuntimeError, AttributeError, ImportError, mujoco.FatalError) as cause:
                raise SceneError(
                    f"MuJoCo cannot draw with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r}: {cause}; set it to egl, "
                    "osmesa or glfw before anything imports mujoco"
                ) from cause
        heading = float(state.heading)
        facing = np.array([np.cos(heading), np.sin(heading), 0.0])
        middle = np.array([*np.asarray(state.position, np.float64), self._ground(np.asarray(state.position))])
        middle[2] += _BODY_HEIGHT
        self._light(middle + 2.0 * _AHEAD * facing)
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = middle + _AHEAD * facing
        camera.distance, camera.azimuth, camera.elevation = _BEHIND + _AHEAD, np.rad2deg(heading), _PITCH_DEG
        self._renderer.update_scene(self._data, camera)
        self._add_robot(middle, facing, float(params.vehicle.radius))
        return self._renderer.render().copy()

    def close(self) -> None:
        """Release the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _ground(self, position: np.ndarray) -> float:
        """Height of the ground at the nearest node of the centreline, m."""
        return float(self._plan.elevation[np.argmin(np.sum((self._plan.centre - position) ** 2, axis=1))])

    def _light(self, place: np.ndarray) -> None:
        """Switch on the lamps nearest to a place, and the others off."""
        away = np.linalg.norm(self._data.light_xpos - place, axis=1)
        self._model.light_active[:] = away <= np.sort(away)[min(_LIT, len(away)) - 1] if len(away) else False

    def _add_robot(self, middle: np.ndarray, facing: np.ndarray, radius: float) -> None:
        """A capsule along the heading, as long as the footprint is wide."""
        scene = self._renderer.scene
        capsule = scene.geoms[scene.ngeom]
        kind, nothing = mujoco.mjtGeom.mjGEOM_CAPSULE, np.zeros(3)
        mujoco.mjv_initGeom(capsule, kind, nothing, nothing, np.eye(3).reshape(-1), _ORANGE)
        half, width = 0.6 * radius * facing, 0.4 * radius
        mujoco.mjv_connector(capsule, kind, width, middle - half, middle + half)
        scene.ngeom += 1
