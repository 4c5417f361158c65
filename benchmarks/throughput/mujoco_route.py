"""The paper's route: one environment on one CPU core, in Python, with `mujoco.mj_multiRay` for its LiDAR.

The robot, odometer, reward and observation are ours, in float64 and with the standard library's `math`, which is
faster than NumPy for single numbers. Contact is judged by the distance to the centreline alone, which costs nothing.
Rays are cast in a built scene folder, or in the walls of a plan, extruded in memory.
"""

from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin
from pathlib import Path
from time import perf_counter
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

import subterra_jax as st
from benchmarks.command import BenchmarkError
from benchmarks.throughput.timing import Speed, Timing
from subterra_jax.tunnel.plan import TunnelPlan

_HALF_HEIGHT = 1.0  # m that extruded walls reach above and below the LiDAR


@dataclass(frozen=True)
class Scene:
    """A compiled scene with every geom in its place.

    Attributes:
        model: Compiled model.
        data: Its state at the first pose.
        height: Height of the LiDAR at each node of the plan's station grid, m, `(n,)`.
        about: Description for reports.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    height: Float[np.ndarray, " n"]
    about: str


def extrude_walls(plan: TunnelPlan, lining: str) -> Scene:
    """Returns upright walls over every segment of a lining, as one mesh."""
    segments = plan.lining(lining).segments
    segments = segments[np.any(segments[:, :2] != segments[:, 2:], axis=1)]
    low, high = np.full((len(segments), 1), -_HALF_HEIGHT), np.full((len(segments), 1), _HALF_HEIGHT)
    start, end = segments[:, :2], segments[:, 2:]
    vertex = np.stack([np.hstack(pair) for pair in ((start, low), (end, low), (end, high), (start, high))], axis=1)
    face = (4 * np.arange(len(segments))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    spec = mujoco.MjSpec()
    mesh = spec.add_mesh(name="walls", uservert=vertex.ravel(), userface=face.ravel())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # open: it has no volume
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="walls", contype=0, conaffinity=0)
    return _make_scene(spec.compile(), np.zeros(len(plan.station)), f"walls of {plan.name}, extruded")


def load_scene(folder: Path, plan: TunnelPlan, lining: str) -> Scene:
    """Loads the model of a scene folder.

    Args:
        folder: Folder written by `scene.build`.
        plan: Tunnel of the same folder.
        lining: `furnished` loads the furnished scene.

    Raises:
        BenchmarkError: The scene is not there, or MuJoCo cannot read it.
    """
    path = folder / ("scene_furnished.xml" if lining == "furnished" else "scene.xml")
    if not path.is_file():
        raise BenchmarkError(f"{path}: no such scene")
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise BenchmarkError(f"{path}: MuJoCo cannot read it ({str(error).splitlines()[0]})") from error
    return _make_scene(model, plan.elevation + plan.lidar_height, str(path))


def _make_scene(model: mujoco.MjModel, height: Float[np.ndarray, " n"], about: str) -> Scene:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return Scene(model, data, height, f"{about}; {model.ngeom:,} geoms, {model.nmeshface:,} faces")


ABOUT = "paper's route: one environment in Python, mj_multiRay, one core"
_VISIBLE = np.array([1, 1, 0, 0, 0, 0], np.uint8)  # geom groups of lining, track and furniture; 2 is the robot's

Info = dict[str, Any]


class MujocoTunnel:
    """The Traverse task with Gymnasium's `reset` and `step`.

    Args:
        scene: Geometry for the rays.
        plan: The same tunnel, for its centreline.
        params: Params of our environment, whose numbers are used.
    """

    def __init__(self, scene: Scene, plan: TunnelPlan, params: st.EnvParams):
        self.scene, self.length = scene, plan.length
        self._spacing = plan.length / (len(plan.station) - 1)
        columns = (plan.centre, plan.tangent, plan.half_width, scene.height)
        self._grid = np.column_stack(columns).tolist()
        self.vehicle = _numbers(params.vehicle, "speed_max", "yaw_rate_max", "radius", "period")
        self.lidar = _numbers(params.lidar, "range_max", "range_sigma")
        self.odometry = _numbers(
            params.odometry, "distance_sigma", "distance_bias_sigma", "heading_sigma", "heading_bias_sigma"
        )
        self.reward = _numbers(params.reward, "terminal", "coverage", "lateral", "jerk")
        self.start = _numbers(params.start, "lateral", "heading")
        self.goal_coverage, self.horizon = float(params.goal_coverage), int(params.horizon)
        n = self.n_beams = params.lidar.n_beams
        self._along, self._across = np.cos(np.arange(n) * 2 * pi / n), np.sin(np.arange(n) * 2 * pi / n)
        self._way, self._geom, self._reach = np.zeros((n, 3)), np.empty(n, np.int32), np.empty(n)

    def reset(self, *, seed: int | None = None) -> tuple[np.ndarray, Info]:
        """Starts an episode; a seed starts a new sequence of episodes."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        x, y, tangent_x, tangent_y, *_ = self._at(0.0)
        offset, turn = self._rng.uniform(-1.0, 1.0, 2)
        bias = self._rng.standard_normal(2)
        offset *= self.start["lateral"]
        self.x, self.y = x - offset * tangent_y, y + offset * tangent_x
        self.heading = _wrap(atan2(tangent_y, tangent_x) + turn * self.start["heading"])
        self.station, self.furthest, self.steps, self.command = 0.0, 0.0, 0, (0.0, 0.0)
        self.distance_bias = bias[0] * self.odometry["distance_bias_sigma"]
        self.heading_bias = bias[1] * self.odometry["heading_bias_sigma"]
        self.distance, self.turned = 0.0, 0.0
        return self._observation(self._rng.standard_normal(self.n_beams)), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Takes one step; does not reset."""
        speed_max, yaw_rate_max, period = (self.vehicle[k] for k in ("speed_max", "yaw_rate_max", "period"))
        noise = self._rng.standard_normal(2 + self.n_beams)
        speed = min(max(float(action[0]), 0.0), speed_max)
        yaw_rate = min(max(float(action[1]), -yaw_rate_max), yaw_rate_max)
        self._drive(speed, yaw_rate, period)
        lateral, half_width = self._foot()
        self._measure_motion(speed, yaw_rate, period, noise)
        radius = self.vehicle["radius"]
        contact = abs(lateral) > half_width - radius or not -radius <= self.station <= self.length + radius
        newly = max(self.station - self.furthest, 0.0)
        self.furthest += newly
        coverage = min(self.furthest / self.length, 1.0)
        success = coverage >= self.goal_coverage and not contact
        jerk = abs(speed - self.command[0]) + abs(yaw_rate - self.command[1])
        weight = self.reward
        reward = weight["terminal"] * success + weight["coverage"] * newly / self.length
        reward -= weight["lateral"] * abs(lateral) / half_width + weight["jerk"] * jerk
        self.command, self.steps = (speed, yaw_rate), self.steps + 1
        terminated = contact or success
        info = {"coverage": coverage, "station": self.station, "contact": contact, "success": success}
        truncated = self.steps >= self.horizon and not terminated
        return self._observation(noise[2:]), reward, terminated, truncated, info

    def ranges(self) -> np.ndarray:
        """Returns the true ranges at the current pose, m, `(n_beams,)`."""
        c, s = cos(self.heading), sin(self.heading)
        self._way[:, 0], self._way[:, 1] = c * self._along - s * self._across, s * self._along + c * self._across
        origin, reach = np.array([self.x, self.y, self._at(self.station)[5]]), self.lidar["range_max"]
        mujoco.mj_multiRay(
            self.scene.model, self.scene.data, origin, self._way.ravel(), _VISIBLE, True, -1, self._geom, self._reach,
            None, self.n_beams, reach,
        )  # fmt: skip
        return np.where(self._geom < 0, reach, np.minimum(self._reach, reach))

    def _observation(self, noise: np.ndarray) -> np.ndarray:
        true, reach = self.ranges(), self.lidar["range_max"]
        noisy = np.clip(true + self.lidar["range_sigma"] * noise, 0.0, reach)
        return np.append(np.where(true < reach, noisy, reach), [self.distance, self.turned]).astype(np.float32)

    def _drive(self, speed: float, yaw_rate: float, period: float) -> None:
        """Moves along the exact arc of a constant command."""
        half = 0.5 * yaw_rate * period
        chord = speed * period * (sin(half) / half if abs(half) > 1e-9 else 1.0)
        self.x += chord * cos(self.heading + half)
        self.y += chord * sin(self.heading + half)
        self.heading = _wrap(self.heading + 2.0 * half)

    def _foot(self) -> tuple[float, float]:
        """Moves the station to the foot of the perpendicular and returns lateral offset and half-width, m."""
        for _ in range(2):
            x, y, tangent_x, tangent_y, half_width, _ = self._at(self.station)
            from_x, from_y = self.x - x, self.y - y
            lateral = tangent_x * from_y - tangent_y * from_x
            self.station += tangent_x * from_x + tangent_y * from_y
        return lateral, half_width

    def _measure_motion(self, speed: float, yaw_rate: float, period: float, noise: np.ndarray) -> None:
        sigma = self.odometry
        self.distance += speed * period * (1.0 + self.distance_bias) + sigma["distance_sigma"] * noise[0]
        self.turned = _wrap(self.turned + (yaw_rate + self.heading_bias) * period + sigma["heading_sigma"] * noise[1])

    def _at(self, station: float) -> tuple[float, ...]:
        """Returns centre x, y, unit tangent x, y, half-width and LiDAR height at a station; extrapolates straight."""
        node = station / self._spacing
        index = min(max(int(node), 0), len(self._grid) - 2)
        share = node - index
        values = [a + share * (b - a) for a, b in zip(self._grid[index], self._grid[index + 1], strict=True)]
        size = hypot(values[2], values[3])
        return (values[0], values[1], values[2] / size, values[3] / size, values[4], values[5])


def measure(env: MujocoTunnel, timing: Timing) -> Speed:
    """Measures one environment under random actions, resets included."""
    rng = np.random.default_rng(timing.seed)
    high = np.array([env.vehicle["speed_max"], env.vehicle["yaw_rate_max"]])
    env.reset(seed=timing.seed)
    rates, total, done = [], 0.0, 0
    for repeat in range(timing.repeats + 1):
        actions = rng.uniform([0.0, -high[1]], high, (timing.steps, 2))
        started = perf_counter()
        for action in actions:
            obs, reward, terminated, truncated, _ = env.step(action)
            total += reward
            if terminated or truncated:
                env.reset()
                done += 1
        elapsed = perf_counter() - started
        total += float(obs.sum())
        if repeat:  # the first call warms up
            rates.append(timing.steps / elapsed)
    return Speed(1, timing.steps, 0.0, rates, done / (timing.steps * (timing.repeats + 1)), total)


def _numbers(part: Any, *names: str) -> dict[str, float]:
    """Returns some fields of a part of the params as Python numbers."""
    return {name: float(getattr(part, name)) for name in names}


def _wrap(angle: float) -> float:
    """Brings an angle at most one turn outside [-π, π] into it, rad."""
    return angle - 2 * pi if angle > pi else angle + 2 * pi if angle < -pi else angle
