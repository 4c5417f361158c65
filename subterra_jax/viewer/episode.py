"""Lines and points of a driven episode in three dimensions; plain arrays, no drawing library."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from subterra_jax.lidar3d.space import into_tunnel, turned
from subterra_jax.parts.obstacles import PITCH
from subterra_jax.recorder.trace import Trace, reckon
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel_env import TunnelEnv
from subterra_jax.viewer.shapes import Centreline

SIGMAS = 2.0  # half axes of the ellipse, in standard deviations
ON_GROUND = 0.06  # m above the ground, of lines on the ground
_POINTS = 1024  # points of a scan that are kept: a browser without a GPU shows them
_ELLIPSE_POINTS = 48
_SLIM = 0.35  # m, half width of an ellipse without an estimate across the tunnel
_NO_LINES = np.zeros((0, 2, 3))


@dataclasses.dataclass(frozen=True)
class Drawn:
    """An episode to draw. Row k of a series is the state after k periods."""

    centreline: Centreline  # its tunnel
    trace: Trace  # the episode
    goal: float  # station of the goal, m; NaN without one
    truth: Float[np.ndarray, "t 3"]  # true positions on the ground, m
    heading: Float[np.ndarray, "t"]  # true headings, rad, unwrapped
    reckoned: Float[np.ndarray, "t 3"]  # positions on the ground by the odometer alone, m
    reckoned_heading: Float[np.ndarray, "t"]  # headings by the odometer alone, rad
    odometer_error: Float[np.ndarray, "t"]  # distance by the odometer less the way driven, m
    # estimated station and its standard deviation, m; NaN without an estimate, and in row 0
    estimate: Float[np.ndarray, "t 2"]
    hits: Float[np.ndarray, "t p 3"]  # returns of the LiDAR, robot's frame on the ground, m; NaN without a return
    boxes: Float[np.ndarray, "b 6"]  # obstacles: middle x, y, unit vector along the first side, half sides, m

    def __len__(self) -> int:
        return len(self.truth)

    def pose(self, at: float, *, reckoned: bool = False) -> tuple[Float[np.ndarray, "3"], float]:
        """Return position (m) and heading (rad), true or dead-reckoned, between two rows."""
        places, headings = (self.reckoned, self.reckoned_heading) if reckoned else (self.truth, self.heading)
        rows = np.arange(len(self))
        return np.array([np.interp(at, rows, axis) for axis in places.T]), float(np.interp(at, rows, headings))

    def ellipse(self, row: int) -> Float[np.ndarray, "n 2 3"]:
        """Return the ellipse of two standard deviations of the agent's estimate, bent along the tunnel, as segments, m.

        Across the tunnel it shows the spread of the particles, or `_SLIM` about the centreline without particles. It is
        empty without an estimate.
        """
        station, sigma = self.estimate[row]
        if not (np.isfinite(station) and np.isfinite(sigma)):
            return _NO_LINES
        middle, across = self._across(row)
        turn = np.linspace(0.0, 2.0 * np.pi, _ELLIPSE_POINTS)
        # A straight stretch of an ellipse 100 m long would leave the tunnel in a bend.
        along = np.clip(station + SIGMAS * sigma * np.cos(turn), -5.0, self.centreline.plan.length + 5.0)
        return _chain(self.centreline.points_at(along, middle + across * np.sin(turn)), 1.5 * ON_GROUND)

    def particles(self, row: int) -> Float[np.ndarray, "k 3"]:
        """Return some of the agent's particles, m."""
        cloud = self._cloud(row)
        return self.centreline.points_at(cloud[:, 0], cloud[:, 1]) + np.array([0.0, 0.0, 2.0 * ON_GROUND])

    def gate(self) -> Float[np.ndarray, "n 2 3"]:
        """Return a gate across the tunnel at the goal, as segments, m; empty without a goal."""
        if not np.isfinite(self.goal):
            return _NO_LINES
        plan, station = self.centreline.plan, np.array([self.goal])
        half = np.interp(station, plan.station, plan.half_width) - 0.05
        left, right = (self.centreline.points_at(station, side * half)[0] for side in (1.0, -1.0))
        up = np.array([0.0, 0.0, 2.2])
        return _chain(np.array([left, left + up, right + up, right, left]), ON_GROUND)

    def _cloud(self, row: int) -> Float[np.ndarray, "k 3"]:
        cloud = self.trace.cloud[row].astype(np.float64)
        return cloud[np.isfinite(cloud).all(axis=1)]

    def _across(self, row: int) -> tuple[float, float]:
        """Return middle and half width of the ellipse across the tunnel, m."""
        cloud = self._cloud(row)
        if not len(cloud):
            return 0.0, _SLIM
        weight = cloud[:, 2] / max(float(cloud[:, 2].sum()), 1e-12)
        mean = float(np.sum(weight * cloud[:, 1]))
        return mean, max(SIGMAS * float(np.sqrt(np.sum(weight * (cloud[:, 1] - mean) ** 2))), 0.15)


def draw(env: TunnelEnv, params: EnvParams, plan: TunnelPlan, trace: Trace) -> Drawn:
    """Return what a driven episode shows.

    Args:
        env: The environment that it was driven in.
        params: The task, in one tunnel.
        plan: That tunnel.
    """
    centreline, state, fields = Centreline(plan), trace.state, env.fields(params)
    heading, station = np.unwrap(np.asarray(state.heading, np.float64)), np.asarray(state.station, np.float64)
    odometry = trace.observation[:, fields["odometry"]]
    reckoned, reckoned_heading = reckon(odometry, state.position[0], float(heading[0]))
    log_sigma = np.clip(trace.action[:, 3], -5.0, 5.0)
    estimate = np.stack([trace.action[:, 2], np.where(np.isnan(trace.action[:, 2]), np.nan, np.exp(log_sigma))], -1)
    way = np.cumsum(np.hypot(*np.diff(np.asarray(state.position, np.float64), axis=0).T))
    return Drawn(
        centreline,
        trace,
        float(trace.observation[0, fields["goal"]][0]) if "goal" in fields else np.nan,
        centreline.lift(np.asarray(state.position, np.float64), station),
        heading,
        centreline.lift(reckoned, station),
        reckoned_heading,
        odometry[:, 0] - np.append(0.0, way),
        np.vstack([np.full((1, 2), np.nan), estimate]),
        _hits(env, params, plan, trace),
        _boxes(env, jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), state), params),
    )


def _chain(points: Float[np.ndarray, "n 3"], above: float) -> Float[np.ndarray, "m 2 3"]:
    """Return a line through points, raised by a height, as segments, m."""
    raised = points + np.array([0.0, 0.0, above])
    return np.stack([raised[:-1], raised[1:]], axis=1)


def _hits(env: TunnelEnv, params: EnvParams, plan: TunnelPlan, trace: Trace) -> Float[np.ndarray, "t p 3"]:
    fields, sensor = env.fields(params), params.lidar
    if "ranges" in fields:
        ranges = trace.observation[:, fields["ranges"]][..., None]
        angle = np.arange(ranges.shape[1]) * (2.0 * np.pi / ranges.shape[1])
        points = ranges * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
        points = points + np.array([0.0, 0.0, plan.lidar_height])
        return np.where((ranges > 0.0) & (ranges < 0.99 * float(sensor.range_max)), points, np.nan)
    stride = max(1, -(-sensor.n_beams // _POINTS))
    ranges = trace.observation[:, fields["scan"]][:, ::stride, None]
    level: Any = tuple(tuple(axis) for axis in jnp.eye(3))
    points = ranges * np.asarray(into_tunnel(turned(level, sensor.mount), sensor.directions[::stride]))
    points = points + np.array([0.0, float(sensor.mount.lateral), 0.0])
    if trace.pose.shape[1]:
        points = _from_trunk(points, trace.state, params)
    else:
        points = points + np.array([0.0, 0.0, float(sensor.mount.height)])
    return np.where((ranges > 0.0) & (ranges < float(sensor.range_max)), points, np.nan)


def _from_trunk(points: Float[np.ndarray, "t p 3"], state: State, params: EnvParams) -> Float[np.ndarray, "t p 3"]:
    """Return points of a trunk's LiDAR, which leans with it, in the robot's level frame, from the ground, m."""
    from subterra_jax.b2.constants import LIDAR  # MuJoCo is loaded only where a robot walks

    qpos, heading = state.legs.body.qpos, np.asarray(state.heading, np.float64)
    lean = Rotation.from_euler("z", -heading[:, None]) * Rotation.from_quat(qpos[:, [4, 5, 6, 3]])
    height = (qpos[:, 2] + float(params.track.protrusion[0]))[:, None, None]
    return (points + np.array(LIDAR)) @ lean.as_matrix().transpose(0, 2, 1) + height * np.array([0.0, 0.0, 1.0])


def _boxes(env: TunnelEnv, state: State, params: EnvParams) -> Float[np.ndarray, "b 6"]:
    stations = jnp.arange(0.0, float(params.tunnel.length) + PITCH, PITCH)
    rows = [np.zeros((0, 6), np.float32)]
    for boxes in jax.device_get(jax.vmap(lambda s: env.boxes(state.replace(station=s), params))(stations)):
        row = np.concatenate([boxes.centre, boxes.axis, boxes.half], axis=-1).reshape(-1, 6)
        rows.append(np.unique(row[np.abs(row[:, 0]) < 1e5], axis=0).astype(np.float32))
    return np.concatenate(rows)
