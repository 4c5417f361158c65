"""Pictures of a walking B2, drawn by MuJoCo: in the scene in which it walks, or in the bore of its tunnel."""

from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from subterra_jax.b2 import track
from subterra_jax.b2.engine import PREFIX, MujocoPhysics, ScenePhysics, rotate_vector
from subterra_jax.b2.model import dress, robot_spec
from subterra_jax.b2.params import WalkParams
from subterra_jax.b2.walk import WalkEnv
from subterra_jax.lidar3d.surface import Triangles
from subterra_jax.pictures.camera import FollowCamera, TunnelChoice
from subterra_jax.pictures.stage import Piece, add_box, add_surface
from subterra_jax.pictures.surfaces import FLOOR, Surface

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


class RobotView:
    """Draws a robot from behind, a little to one side.

    Args:
        walk: The environment; its physics must be MuJoCo's own.
        params: Its params.
        tunnel: The tunnel to draw where there is no scene.
        width: Width of a picture, pixels.
        height: Height of a picture, pixels.
    """

    def __init__(self, walk: WalkEnv, params: WalkParams, tunnel: TunnelChoice, width: int = 480, height: int = 480):
        assert isinstance(walk.physics, MujocoPhysics)
        self._physics, self._track, self._choice, self._size = walk.physics, params.track, tunnel, (width, height)

    @cached_property
    def _camera(self) -> FollowCamera:
        # Drawn is a model of its own, which wears the robot's looks: physics has neither their meshes nor their cost.
        if not isinstance(self._physics, ScenePhysics):
            unlike_the_plan = ("rail", "sleeper", "floor")  # the robot walks on its own track
            return FollowCamera(self._choice, *self._size, leave_out=unlike_the_plan, furnish=self._furnish)
        spec = self._physics.scene_spec()
        dress(spec, PREFIX)
        return FollowCamera(self._choice, *self._size, spec.compile())

    def picture(self, env: Any, params: Any, state: Any, obs: np.ndarray) -> np.ndarray:
        """Draw a state, `(height, width, 3)` uint8; see `pictures.views.View`.

        Raises:
            PictureError: There is no OpenGL.
        """
        walk = state if isinstance(env, WalkEnv) else state.legs.walk
        qpos = np.array(walk.body.qpos, np.float64)
        qpos[:3] += np.asarray(self._track.position[walk.anchor], np.float64)
        return self.draw(qpos)

    def draw(self, qpos: Float[np.ndarray, "19"]) -> np.ndarray:
        """Draw a robot at a pose in the tunnel frame; see `picture`."""
        middle, ahead = qpos[:3], rotate_vector(qpos[3:7], np.array([1.0, 0.0, 0.0]))
        camera = self._camera
        if not isinstance(self._physics, ScenePhysics):
            camera.follow(0, middle, ahead)
        camera.data.qpos[:_N_POSE] = qpos
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

    def _furnish(self, spec: mujoco.MjSpec, piece: Piece) -> None:
        """Add the robot, the sleepers on which it walks, rails beside them and ballast below."""
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
        robot = robot_spec()
        dress(robot)
        spec.option, robot.option.timestep = robot.option, robot.option.timestep
        spec.attach(robot, prefix=PREFIX, frame=spec.worldbody.add_frame())


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
