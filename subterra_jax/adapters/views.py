"""The pictures of `render`: the plan from above, or scene or bore through MuJoCo."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import jax
import numpy as np

from subterra_jax.host.errors import SubterraError
from subterra_jax.lidar3d.beams import level_ring
from subterra_jax.parts.boxes import Boxes
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.pictures.carrier import add_carrier
from subterra_jax.pictures.renderer import import_mujoco, light_near, open_renderer
from subterra_jax.pictures.stage import Piece, stage_spec
from subterra_jax.pictures.top_down import top_down, wall_points
from subterra_jax.procedural import expand
from subterra_jax.state import EnvParams, State
from subterra_jax.tasks import TASKS, find, is_planar, tunnel_for
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import Source, load_tunnel, tunnel_of
from subterra_jax.tunnel_env import TunnelEnv

VIEWS = ("top", "mujoco")
SIZE = 480
_BEHIND, _PITCH_DEG, _AHEAD = 4.0, -14.0, 1.0  # of the robot's middle: m, degrees, m
_BODY_HEIGHT = 0.55  # m above the ground, of the point that the camera follows


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


def make_view(view: str, scene: str | Path | None, choice: "TunnelChoice | None" = None) -> View:
    """Return a view by its name.

    Args:
        view: One of `VIEWS`.
        scene: Scene to show; `None`: no scene.
        choice: Tunnel to show without a scene; the packaged one if left out.

    Raises:
        ValueError: The view does not exist.
        MissingLibraryError: MuJoCo is not installed.
        SceneError: The scene cannot be read.
    """
    if view not in VIEWS:
        raise ValueError(f"view must be one of {VIEWS}, got {view!r}")
    if view == "top":
        return TopView(scene)
    return MujocoView(None if scene is None else Path(scene), choice)


def view_for(
    view: str,
    scene: str | Path | None,
    task: str,
    tunnel: Source | Sequence[Source],
    split: str | None,
    lining: str | None,
    sensor: Any = SENSORS[0],
) -> tuple[View, Any]:
    """Return the view of an environment that `subterra_jax.make` is to make, and its tunnel; errors as there."""
    known = TASKS.get(id := find(task))
    if scene is not None and tunnel is None and split is None:
        tunnel = tunnel_of(Path(scene))
    tunnel = tunnel_for(id, tunnel, split, spatial=not is_planar(sensor))
    return make_view(view, scene, TunnelChoice(tunnel, lining, None if known is None else known.piece)), tunnel


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
    """The tunnel from a camera behind the robot, drawn by MuJoCo.

    Of a scene it shows the scene itself. Without one it draws the bore of the tunnel's file or drawing, a piece of
    100 m around the robot at a time; a tunnel without a bore has upright walls below an assumed crown.

    Args:
        scene: Folder that `scene.build` wrote, or one of its MJCF files (`scene_furnished.xml`); `None`: no scene.
        choice: Tunnel to draw without a scene.
    """

    def __init__(self, scene: Path | None, choice: "TunnelChoice | None" = None):
        self._mujoco, self._scene, self._choice = import_mujoco("view='mujoco'"), scene, choice or TunnelChoice()
        self.tunnel: Path | None = None if scene is None else tunnel_of(scene)
        self._plan: TunnelPlan | None = None
        self._piece: Piece | None = None
        self._of = -1  # number of the tunnel that the plan is of
        self._model: Any = None
        self._renderer: Any = None
        if scene is not None and self.tunnel is not None:
            path = scene / "scene.xml" if scene.is_dir() else scene
            for needed in (path, self.tunnel):
                if not needed.is_file():
                    raise SceneError(f"{scene} is no scene folder: {needed} is missing")
            try:
                self._show(self._mujoco.MjModel.from_xml_path(str(path)))
            except ValueError as cause:
                raise SceneError(f"{path} cannot be loaded: {cause}") from cause
            self._plan = load_tunnel(self.tunnel)

    def picture(self, env: TunnelEnv, params: EnvParams, state: State, obs: np.ndarray) -> np.ndarray:
        """See `View`; the observation is not used.

        Raises:
            PictureError: There is no OpenGL.
            ValueError: The environment was given a ready `Tunnel`, which holds no heights.
        """
        heading = float(state.heading)
        facing = np.array([np.cos(heading), np.sin(heading), 0.0])
        if self._scene is None:
            self._draw_piece(state, facing)
        assert self._plan is not None
        if self._renderer is None:
            self._renderer = open_renderer(self._model, SIZE, SIZE)
        ground, slope = self._ground(np.asarray(state.position, np.float64), facing)
        middle = ground + np.array([0.0, 0.0, _BODY_HEIGHT])
        light_near(self._model, self._data, middle + 2.0 * _AHEAD * facing)
        camera = self._mujoco.MjvCamera()
        camera.type = self._mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = middle + _AHEAD * facing
        camera.distance, camera.azimuth, camera.elevation = _BEHIND + _AHEAD, np.rad2deg(heading), _PITCH_DEG
        self._renderer.update_scene(self._data, camera)
        radius, height = float(params.vehicle.radius), self._plan.lidar_height
        add_carrier(self._renderer.scene, ground, heading, slope, radius, height)
        return self._renderer.render().copy()

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        """Open the scene anew in a copy or another process: neither module nor renderer can be copied."""
        return type(self), (self._scene, self._choice)

    def close(self) -> None:
        """Release the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _show(self, model: Any) -> None:
        """Take another model."""
        self.close()
        self._model, self._data = model, self._mujoco.MjData(model)
        self._mujoco.mj_forward(model, self._data)

    def _draw_piece(self, state: State, facing: np.ndarray) -> None:
        """Make the model of the piece around the robot, if the present one does not show it."""
        number, station = int(state.tunnel), float(state.station)
        if self._plan is None or number != self._of:
            self._plan, self._piece, self._of = self._choice.plan(number), None, number
        node = int(np.argmin(np.abs(self._plan.station - station)))
        along = float(facing[:2] @ self._plan.tangent[node])
        if self._piece is None or not self._piece.shows(station, along):
            self._piece = Piece.around(self._plan, self._choice.lining, station, along)
            self._show(stage_spec(self._piece).compile())

    def _ground(self, position: np.ndarray, facing: np.ndarray) -> tuple[np.ndarray, float]:
        """Point on the ground below a position, m, and its slope ahead, rad, at the nearest node of the centreline."""
        assert self._plan is not None
        plan = self._plan
        node = int(np.argmin(np.sum((plan.centre - position) ** 2, axis=1)))
        rise = np.gradient(plan.elevation, plan.station)[node] * float(facing[:2] @ plan.tangent[node])
        return np.array([*position, plan.elevation[node]]), float(np.arctan(rise))


@dataclasses.dataclass(frozen=True)
class TunnelChoice:
    """The tunnels of an environment by number.

    Attributes:
        tunnel: As for `subterra_jax.make`.
        lining: As for `subterra_jax.make`.
        piece: Start and length of the piece that the task cuts out, m; `None` for the whole.
    """

    tunnel: Source | Sequence[Source] = None
    lining: str | None = None
    piece: tuple[float, float] | None = None

    def plan(self, number: int) -> TunnelPlan:
        """Return the plan of a tunnel, with its bore where there is one.

        Raises:
            ValueError: It is a ready `Tunnel`, which holds no heights.
        """
        source: Any = self.tunnel
        if isinstance(source, str | Path):
            source = expand(str(source)) if len(expand(str(source))) > 1 else source
        if not (source is None or isinstance(source, str | Path | TunnelPlan | Tunnel)):
            source = source[number]
        if isinstance(source, Tunnel):
            raise ValueError("view='mujoco' needs the tunnel's name, file or plan: a ready Tunnel holds no heights")
        plan = source if isinstance(source, TunnelPlan) else load_tunnel(source, solid=True)
        if self.piece is None:
            return plan
        start, length = self.piece
        return plan.slice(start, min(length, plan.length - start))
