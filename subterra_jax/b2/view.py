"""Pictures of a walking B2, drawn by MuJoCo: in the scene in which it walks, or in the bore of its tunnel."""

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from subterra_jax.adapters.views import TunnelChoice
from subterra_jax.b2 import track
from subterra_jax.b2.engine import PREFIX, MujocoPhysics, ScenePhysics, rotate_vector
from subterra_jax.b2.model import dress, robot_spec
from subterra_jax.b2.params import WalkParams
from subterra_jax.b2.walk import WalkEnv
from subterra_jax.lidar3d.surface import Triangles
from subterra_jax.pictures.renderer import PictureError as PictureError
from subterra_jax.pictures.renderer import light_near, open_renderer
from subterra_jax.pictures.stage import Piece, add_box, add_surface, stage_spec
from subterra_jax.pictures.surfaces import FLOOR, Surface
from subterra_jax.tunnel.plan import TunnelPlan

_BEHIND, _PITCH_DEG, _ASIDE_DEG = 2.9, -15.0, 24.0  # of the point looked at: m, degrees, degrees
_AHEAD, _BELOW = 0.35, 0.1  # of the trunk, that point, m
_RAIL, _SLEEPER = (0.40, 0.33, 0.28), (0.62, 0.61, 0.58)
_BED_BEYOND = 0.5  # m behind the walls
_N_POSE = 19  # numbers of the robot's pose: position, quaternion, joints


def place(data: mujoco.MjData, origin: Any) -> Float[np.ndarray, "19"]:
    """Return the robot's pose in the tunnel frame from data whose origin lies at a position there, m."""
    qpos = np.array(data.qpos[:_N_POSE])
    qpos[:3] += np.asarray(origin, np.float64)
    return qpos


class Camera:
    """Draws a robot from behind, a little to one side; in its scene, or in a piece of its tunnel's bore.

    Args:
        walk: The environment; its physics must be MuJoCo's own.
        params: Its params.
        tunnel: The tunnel to draw where there is no scene.
        width: Width of a picture, pixels.
        height: Height of a picture, pixels.

    Raises:
        PictureError: There is no OpenGL.
    """

    def __init__(self, walk: WalkEnv, params: WalkParams, tunnel: TunnelChoice, width: int = 480, height: int = 480):
        assert isinstance(walk.physics, MujocoPhysics)
        self._robot, self._track, self._choice = walk.physics.robot, params.track, tunnel
        self._size = width, height
        self._renderer: mujoco.Renderer | None = None
        self._plan: TunnelPlan | None = None
        self._piece: Piece | None = None
        # Drawn is a model of its own, which wears the robot's looks: physics has neither their meshes nor their cost.
        if isinstance(walk.physics, ScenePhysics):
            spec = walk.physics.scene_spec()
            dress(spec, PREFIX)
            self._show(spec.compile())
        else:
            self._plan = tunnel.plan(0)

    def draw(self, qpos: Float[np.ndarray, "19"]) -> np.ndarray:
        """Draw a robot at a pose in the tunnel frame, `(height, width, 3)` uint8."""
        middle, ahead = qpos[:3], rotate_vector(qpos[3:7], np.array([1.0, 0.0, 0.0]))
        if self._plan is not None:
            self._draw_piece(self._plan, middle, ahead)
        data = self._data
        data.qpos[:_N_POSE] = qpos
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_camlight(self._model, data)
        light_near(self._model, data, middle + 2.0 * ahead)
        camera = mujoco.MjvCamera()
        camera.type, camera.lookat[:] = mujoco.mjtCamera.mjCAMERA_FREE, middle + _AHEAD * ahead
        camera.lookat[2] -= _BELOW
        camera.distance, camera.elevation = _BEHIND, _PITCH_DEG
        camera.azimuth = np.rad2deg(np.arctan2(ahead[1], ahead[0])) + _ASIDE_DEG
        assert self._renderer is not None
        self._renderer.update_scene(data, camera)
        return self._renderer.render().copy()

    def close(self) -> None:
        """Releases the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _show(self, model: mujoco.MjModel) -> None:
        """Takes a model; drawing must not change the solver's data, so it has data of its own."""
        self.close()
        self._model, self._data = model, mujoco.MjData(model)
        self._renderer = open_renderer(model, *self._size)

    def _draw_piece(self, plan: TunnelPlan, middle: np.ndarray, ahead: np.ndarray) -> None:
        """Makes the model of the piece around the robot, if the present one does not show it."""
        node = int(np.argmin(np.sum((plan.centre - middle[:2]) ** 2, axis=1)))
        station, facing = float(plan.station[node]), float(ahead[:2] @ plan.tangent[node])
        if self._piece is not None and self._piece.shows(station, facing):
            return
        self._piece = Piece.around(plan, self._choice.lining, station, facing)
        spec = stage_spec(self._piece, leave_out=("rail", "sleeper", "floor"))
        self._add_track(spec, self._piece)
        robot = robot_spec(self._robot)
        dress(robot)
        spec.option, robot.option.timestep = robot.option, robot.option.timestep
        spec.attach(robot, prefix=PREFIX, frame=spec.worldbody.add_frame())
        self._show(spec.compile())

    def _add_track(self, spec: mujoco.MjSpec, piece: Piece) -> None:
        """Adds the sleepers on which the robot walks, rails beside them and ballast below."""
        station = np.asarray(self._track.station, np.float64)
        chosen = np.flatnonzero((station >= piece.start) & (station <= piece.end))
        position, turn = (np.asarray(part, np.float64) for part in (self._track.position, self._track.quaternion))
        half = 0.5 * float(np.median(np.diff(station)))
        depth, (rail, height) = 0.05, track.RAIL_HALF
        for k in chosen:
            sunk = position[k] - rotate_vector(turn[k], np.array([0.0, 0.0, depth]))
            add_box(spec, (*track.SLEEPER_HALF, depth), sunk, turn[k], _SLEEPER)
            for side in (track.RAIL_OFFSET, -track.RAIL_OFFSET):
                middle = position[k] + rotate_vector(turn[k], np.array([0.0, side, height]))
                add_box(spec, (half + 0.01, rail, height), middle, turn[k], _RAIL)
        add_surface(spec, _bed(piece, float(self._track.protrusion)))


def _bed(piece: Piece, protrusion: float) -> Surface:
    """Return the ballast from wall to wall, `protrusion` m below the ground of the tunnel's file."""
    plan = piece.plan
    node = np.flatnonzero((plan.station >= piece.start) & (plan.station <= piece.end))
    left = np.stack([-plan.tangent[node, 1], plan.tangent[node, 0]], axis=-1)
    reach = (plan.half_width[node] + _BED_BEYOND)[:, None] * left
    height = plan.elevation[node, None] - protrusion
    points = np.concatenate([np.hstack([plan.centre[node] + side * reach, height]) for side in (1.0, -1.0)])
    first, n = np.arange(len(node) - 1), len(node)
    faces = [np.stack(corner, 1) for corner in ((first, first + n, first + 1), (first + 1, first + n, first + n + 1))]
    return Surface("bed", Triangles(points, np.concatenate(faces)), FLOOR, points[:, :2])
