"""The pictures of `render`: the plan from above, or the scene through MuJoCo."""

import functools
import os
import sys
from pathlib import Path
from typing import Any, Protocol

import jax
import numpy as np

from subterra_jax.drawing import top_down, wall_points
from subterra_jax.host.errors import MissingLibraryError, SubterraError
from subterra_jax.lidar3d.beams import level_ring
from subterra_jax.parts.boxes import Boxes
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import load_tunnel, tunnel_of
from subterra_jax.tunnel_env import TunnelEnv

VIEWS = ("top", "mujoco")
SIZE = 480
_BEHIND, _PITCH_DEG, _AHEAD = 4.0, -14.0, 1.0  # of the robot's middle: m, degrees, m
_LIT = 7  # OpenGL lights a scene with eight lights, the headlight among them
_BODY_HEIGHT = 0.55  # m above the ground, of the capsule's axis
_ORANGE = np.array([0.9, 0.42, 0.08, 1.0], np.float32)


class SceneError(SubterraError):
    """A scene cannot be read or drawn."""


class View(Protocol):
    """A way to picture an environment.

    Attributes:
        tunnel: Tunnel file of the scene; `None` without a scene.
    """

    tunnel: Path | None

    def picture(self, env: TunnelEnv, params: EnvParams, state: State, obs: np.ndarray) -> np.ndarray:
        """Return a picture, `(480, 480, 3)` uint8, of a state and its observation `(n_obs,)`."""
        ...

    def close(self) -> None:
        """Release the renderer, if there is one."""
        ...


def make_view(view: str, scene: str | Path | None) -> View:
    """Return a view by its name.

    Raises:
        ValueError: The view does not exist, or needs a scene.
        MissingLibraryError: MuJoCo is not installed.
        SceneError: The scene cannot be read.
    """
    if view not in VIEWS:
        raise ValueError(f"view must be one of {VIEWS}, got {view!r}")
    if view == "top":
        return TopView(scene)
    if scene is None:
        raise ValueError("view='mujoco' needs scene=, a folder that scene.build wrote")
    return MujocoView(Path(scene))


class TopView:
    """The plan from above: walls, boxes, the goal, the beams and the robot. Needs no GL."""

    def __init__(self, scene: str | Path | None = None):
        self.tunnel = None if scene is None else tunnel_of(Path(scene))

    def picture(self, env: TunnelEnv, params: EnvParams, state: State, obs: np.ndarray) -> np.ndarray:
        """See `View`."""
        tunnel, fields = params.tunnel.pick(int(state.tunnel)), env.fields(params)
        goal = float(obs[fields["goal"]][0]) if "goal" in fields else None
        return top_down(
            wall_points(tunnel, int(tunnel.scan_first[_node(tunnel, float(state.station))])),
            np.asarray(state.position, np.float64),
            float(state.heading),
            float(params.vehicle.radius),
            obs[fields["ranges"]] if "ranges" in fields else level_ring(obs[fields["scan"]], params.lidar.shape),
            goal=None if goal is None else _line_across(tunnel, goal),
            boxes=jax.device_get(_boxes_near(env, state, params)),
        )

    def close(self) -> None:
        """Do nothing."""


@functools.partial(jax.jit, static_argnums=0)
def _boxes_near(env: TunnelEnv, state: State, params: EnvParams) -> list[Boxes]:
    return env.boxes(state, params)


def _node(tunnel: Tunnel, station: float) -> int:
    """Return the row of the tunnel's grid nearest to a station."""
    node = np.clip(round(station / float(tunnel.spacing)), 0, int(tunnel.n_nodes) - 1)
    return int(tunnel.first_node) + int(node)


def _line_across(tunnel: Tunnel, station: float) -> np.ndarray:
    """Return both ends of a line from wall to wall at a station, m, `(2, 2)`."""
    row = _node(tunnel, station)
    *centre, tangent_x, tangent_y, half_width = np.asarray(tunnel.grid[row], np.float64)
    beyond = station - (row - int(tunnel.first_node)) * float(tunnel.spacing)
    middle = np.array(centre) + beyond * np.array([tangent_x, tangent_y])
    across = half_width * np.array([-tangent_y, tangent_x])
    return np.stack([middle - across, middle + across])


class MujocoView:
    """The scene from a camera behind the robot, drawn by MuJoCo; the robot is a capsule as wide as its footprint.

    Args:
        scene: Folder that `scene.build` wrote, or one of its MJCF files (`scene_furnished.xml`).
    """

    def __init__(self, scene: Path):
        self._mujoco, self._scene = _import_mujoco(), scene
        path = scene / "scene.xml" if scene.is_dir() else scene
        self.tunnel: Path | None = tunnel_of(scene)
        for needed in (path, self.tunnel):
            if not needed.is_file():
                raise SceneError(f"{scene} is no scene folder: {needed} is missing")
        try:
            self._model = self._mujoco.MjModel.from_xml_path(str(path))
        except ValueError as cause:
            raise SceneError(f"{path} cannot be loaded: {cause}") from cause
        self._plan: TunnelPlan = load_tunnel(self.tunnel)
        self._data = self._mujoco.MjData(self._model)
        self._mujoco.mj_forward(self._model, self._data)
        self._renderer: Any = None

    def picture(self, env: TunnelEnv, params: EnvParams, state: State, obs: np.ndarray) -> np.ndarray:
        """See `View`; the observation is not used."""
        if self._renderer is None:
            try:
                self._renderer = self._mujoco.Renderer(self._model, SIZE, SIZE)
            except (RuntimeError, AttributeError, ImportError, self._mujoco.FatalError) as cause:
                raise SceneError(
                    f"MuJoCo cannot draw with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r}: {cause}; set it to egl, "
                    "osmesa or glfw before anything imports mujoco"
                ) from cause
        heading = float(state.heading)
        facing = np.array([np.cos(heading), np.sin(heading), 0.0])
        middle = np.array([*np.asarray(state.position, np.float64), self._ground(np.asarray(state.position))])
        middle[2] += _BODY_HEIGHT
        self._light(middle + 2.0 * _AHEAD * facing)
        camera = self._mujoco.MjvCamera()
        camera.type = self._mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = middle + _AHEAD * facing
        camera.distance, camera.azimuth, camera.elevation = _BEHIND + _AHEAD, np.rad2deg(heading), _PITCH_DEG
        self._renderer.update_scene(self._data, camera)
        self._add_robot(middle, facing, float(params.vehicle.radius))
        return self._renderer.render().copy()

    def __reduce__(self) -> tuple[Any, tuple[Path]]:
        """Open the scene anew in a copy or another process: neither module nor renderer can be copied."""
        return type(self), (self._scene,)

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
        kind, nothing = self._mujoco.mjtGeom.mjGEOM_CAPSULE, np.zeros(3)
        self._mujoco.mjv_initGeom(capsule, kind, nothing, nothing, np.eye(3).reshape(-1), _ORANGE)
        half, width = 0.6 * radius * facing, 0.4 * radius
        self._mujoco.mjv_connector(capsule, kind, width, middle - half, middle + half)
        scene.ngeom += 1


def _import_mujoco() -> Any:
    """Import MuJoCo, with EGL where there is no display: MuJoCo reads `MUJOCO_GL` once, at its import."""
    if sys.platform == "linux" and "mujoco" not in sys.modules and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import mujoco
    except ImportError as missing:
        raise MissingLibraryError("view='mujoco'", "mujoco") from missing
    return mujoco
