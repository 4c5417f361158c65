"""What `render` shows: the plan from above, or the scene through MuJoCo."""

import functools
from pathlib import Path
from typing import Protocol

import jax
import numpy as np

from subterra_jax.drawing import top_down, wall_points
from subterra_jax.env import TunnelEnv
from subterra_jax.parts.boxes import Boxes
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.sources import tunnel_of

VIEWS = ("top", "mujoco")


class View(Protocol):
    """A way to picture an environment.

    Attributes:
        tunnel: The tunnel file that belongs to what is shown; None if it has none of its own.
    """

    tunnel: Path | None

    def picture(self, env: TunnelEnv, params: EnvParams, state: State, obs: np.ndarray) -> np.ndarray:
        """One picture, `(480, 480, 3)` uint8, of a state and the observation `(n_obs,)` made in it."""
        ...

    def close(self) -> None:
        """Release what was held."""
        ...


def make_view(view: str, scene: str | Path | None) -> View:
    """A view by its name.

    Raises:
        ValueError: There is no such view, or it lacks the scene that it needs.
        SceneError: The scene cannot be read.
    """
    if view not in VIEWS:
        raise ValueError(f"view must be one of {VIEWS}, got {view!r}")
    if view == "top":
        return TopView(scene)
    if scene is None:
        raise ValueError("view='mujoco' needs scene=, a folder that scene.build wrote")
    from subterra_jax.adapters.camera import MujocoView

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
            obs[fields["ranges"]],
            goal=None if goal is None else _line_across(tunnel, goal),
            boxes=jax.device_get(_boxes_near(env, state, params)),
        )

    def close(self) -> None:
        """Nothing is held."""


@functools.partial(jax.jit, static_argnums=0)
def _boxes_near(env: TunnelEnv, state: State, params: EnvParams) -> list[Boxes]:
    return env.boxes(state, params)


def _node(tunnel: Tunnel, station: float) -> int:
    """Row of the tunnel's grid that is nearest to a station."""
    node = np.clip(round(station / float(tunnel.spacing)), 0, int(tunnel.n_nodes) - 1)
    return int(tunnel.first_node) + int(node)


def _line_across(tunnel: Tunnel, station: float) -> np.ndarray:
    """Both ends of a line from wall to wall at a station, m, `(2, 2)`."""
    row = _node(tunnel, station)
    *centre, tangent_x, tangent_y, half_width = np.asarray(tunnel.grid[row], np.float64)
    beyond = station - (row - int(tunnel.first_node)) * float(tunnel.spacing)
    middle = np.array(centre) + beyond * np.array([tangent_x, tangent_y])
    across = half_width * np.array([-tangent_y, tangent_x])
    return np.stack([middle - across, middle + across])
