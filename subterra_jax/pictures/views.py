"""The pictures of `render`: the plan from above, or the bore through MuJoCo."""

import functools
from collections.abc import Sequence
from typing import Any, Protocol

import jax
import numpy as np

from subterra_jax.lidar3d.beams import level_ring
from subterra_jax.parts.part import Boxes
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.pictures.camera import FollowCamera, TunnelChoice
from subterra_jax.pictures.stage import add_carrier
from subterra_jax.pictures.top_down import top_down, wall_points
from subterra_jax.state import EnvParams, State
from subterra_jax.tasks import TASKS, find, is_planar, tunnel_for
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import Source
from subterra_jax.tunnel_env import TunnelEnv

VIEWS = ("top", "mujoco")
SIZE = 480
_BEHIND, _PITCH_DEG, _AHEAD = 4.0, -14.0, 1.0  # of the robot's middle: m, degrees, m
_BODY_HEIGHT = 0.55  # m above the ground, of the point that the camera follows


class View(Protocol):
    """A way to picture an environment."""

    def picture(self, env: TunnelEnv, params: EnvParams, state: Any, obs: np.ndarray) -> np.ndarray:
        """Return a picture, `(height, width, 3)` uint8, of a state and its observation `(n_obs,)`."""
        ...

    def close(self) -> None: ...


def make_view(view: str, choice: TunnelChoice | None = None) -> View:
    """Return a view by its name.

    Args:
        view: One of `VIEWS`.
        choice: Tunnel to show; the packaged one if left out.

    Raises:
        ValueError: The view does not exist.
        MissingLibraryError: MuJoCo is not installed.
    """
    if view not in VIEWS:
        raise ValueError(f"view must be one of {VIEWS}, got {view!r}")
    return TopView() if view == "top" else MujocoView(choice or TunnelChoice())


def view_for(
    view: str,
    task: str,
    tunnel: Source | Sequence[Source],
    split: str | None,
    lining: str | None,
    sensor: Any = SENSORS[0],
    texture: float = 0.0,
) -> tuple[View, Any]:
    """Return the view of an environment that `subterra_jax.make` is to make, and its tunnel; errors as there."""
    known = TASKS.get(id := find(task))
    tunnel = tunnel_for(id, tunnel, split, spatial=not is_planar(sensor))
    return make_view(view, TunnelChoice(tunnel, lining, None if known is None else known.stretch, texture)), tunnel


class TopView:
    """The plan from above: walls, boxes, the goal, the beams and the robot. Needs no GL."""

    def picture(self, env: TunnelEnv, params: EnvParams, state: State, obs: np.ndarray) -> np.ndarray:
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
    """The bore of the tunnel from a camera behind the robot, drawn by MuJoCo.

    A tunnel without a bore has upright walls below an assumed crown.
    """

    def __init__(self, choice: TunnelChoice):
        self._camera = FollowCamera(choice, SIZE, SIZE)

    def picture(self, env: TunnelEnv, params: EnvParams, state: State, obs: np.ndarray) -> np.ndarray:
        """See `View`; the observation is not used.

        Raises:
            PictureError: There is no OpenGL.
            ValueError: The environment was given a ready `Tunnel`, which holds no heights.
        """
        position, heading = np.asarray(state.position, np.float64), float(state.heading)
        facing = np.array([np.cos(heading), np.sin(heading), 0.0])
        plan = self._camera.follow(int(state.tunnel), position, facing)
        ground, slope = _ground(plan, position, facing)
        middle = ground + np.array([0.0, 0.0, _BODY_HEIGHT])
        body = (ground, heading, slope, float(params.vehicle.radius), plan.lidar_height)
        return self._camera.draw(
            target=middle + _AHEAD * facing,
            lit=middle + 2.0 * _AHEAD * facing,
            distance=_BEHIND + _AHEAD,
            azimuth=np.rad2deg(heading),
            elevation=_PITCH_DEG,
            add=lambda scene: add_carrier(scene, *body),
        )

    def close(self) -> None:
        self._camera.close()


def _ground(plan: TunnelPlan, position: np.ndarray, facing: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the point on the ground below a position, m, and its slope ahead, rad, at the nearest node."""
    node = int(np.argmin(np.sum((plan.centre - position) ** 2, axis=1)))
    rise = np.gradient(plan.elevation, plan.station)[node] * float(facing[:2] @ plan.tangent[node])
    return np.array([*position, plan.elevation[node]]), float(np.arctan(rise))
