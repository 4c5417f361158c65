"""Navigation from wheels to legs: a planar stand-in on which it is cheap to learn, and the trial on many B2s.

The stand-in obeys late and nods, as the walking robot does.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.baselines.agent import Agent
from subterra_jax.episode import Driver, Episode, Taken
from subterra_jax.lidar import bearings
from subterra_jax.parts import Noise, PlanarLidar, SensingState, Unicycle
from subterra_jax.parts.unicycle import clip_action
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel_env import TunnelEnv

_CHUNK = 25  # steps between two looks at whether any robot is still on its way


@dataclasses.dataclass(frozen=True)
class Lag:
    """First-order lags of speed and yaw rate.

    The defaults were identified from the released gait: 900 steps of six robots in MuJoCo, steered along the
    centreline with noisy commands.
    """

    speed: float = 0.38  # time constant of the forward speed, s
    yaw_rate: float = 0.24  # time constant of the yaw rate, s
    speed_gain: float = 1.01  # final speed over a lasting command, 1
    yaw_rate_gain: float = 1.07  # final yaw rate over a lasting command, 1


@dataclasses.dataclass(frozen=True)
class Nod:
    """Random lean of the trunk in each step; beams that point down end on the ballast."""

    pitch: float = 0.03  # mean pitch, nose down, rad
    pitch_sigma: float = 0.04  # standard deviation of the pitch, rad
    roll_sigma: float = 0.03  # standard deviation of the roll, rad
    height: float = 0.75  # height of the LiDAR over the ballast, m


@dataclasses.dataclass(frozen=True)
class LaggedWheels(Unicycle):
    """A robot that follows its commands through two first-order lags.

    `State.command` is the motion of the robot, so that the reward's jerk is that of its motion.
    """

    lag: Lag = Lag()  # the lags

    def obey(self, action: Float[Array, "n_action"], state: State, params: EnvParams) -> Float[Array, "2"]:
        """Follow the clipped command, late."""
        lag, period = self.lag, jnp.asarray(params.vehicle.period)
        target = clip_action(action[:2], params.vehicle) * jnp.array([lag.speed_gain, lag.yaw_rate_gain])
        share = 1.0 - jnp.exp(-period / jnp.array([lag.speed, lag.yaw_rate]))
        return clip_action(state.command + share * (target - state.command), params.vehicle)


@dataclasses.dataclass(frozen=True)
class NoddingLidar(PlanarLidar):
    """A planar LiDAR that leans with the trunk: beams that point down end on the ballast."""

    nod: Nod = Nod()  # lean of the trunk

    def normals(self, params: EnvParams) -> int:
        """One for each beam, then pitch and roll."""
        return super().normals(params) + 2

    def observe(self, own: Any, sensing: SensingState, noise: Noise, params: EnvParams) -> dict[str, Array]:
        """Return noisy `ranges`, m."""
        n_beams, nod = params.lidar.n_beams, self.nod
        seen = super().observe(own, sensing, Noise(noise.normal[:n_beams]), params)["ranges"]
        bearing = jnp.asarray(bearings(n_beams), jnp.float32)
        pitch = nod.pitch + nod.pitch_sigma * noise.normal[n_beams]
        roll = nod.roll_sigma * noise.normal[n_beams + 1]
        sinking = jnp.sin(pitch) * jnp.cos(bearing) - jnp.sin(roll) * jnp.sin(bearing)
        ground = jnp.where(sinking > 1e-3, nod.height / jnp.maximum(sinking, 1e-3), jnp.inf)
        return {"ranges": jnp.minimum(seen, ground)}


def stand_in(env: TunnelEnv, lag: Lag = Lag(), nod: Nod = Nod()) -> TunnelEnv:
    """Make the planar stand-in of the walking robot: the same task on wheels that lag, with a LiDAR that nods.

    Args:
        lag: Lags of the robot.
        nod: Lean of its trunk.
    """
    parts = tuple(NoddingLidar(nod) if part.name == PlanarLidar.name else part for part in env.parts)
    return dataclasses.replace(env, motion=LaggedWheels(lag), parts=parts)


@struct.dataclass
class Walk:
    """Robots on their way."""

    state: State  # state of the environment
    over: Bool[Array, "*n"]  # the robot has arrived or failed
    success: Bool[Array, "*n"]  # the robot has arrived
    contact: Bool[Array, "*n"]  # the robot touched a wall
    fall: Bool[Array, "*n"]  # the robot fell
    steps: Int[Array, "*n"]  # steps taken


def walk_robots(
    env: TunnelEnv,
    params: EnvParams,
    agent: Agent,
    n_robots: int,
    seed: int = 0,
    watch: Callable[[Walk], None] | None = None,
) -> tuple[Walk, Float[np.ndarray, "n"]]:
    """Let robots walk until all have arrived or failed.

    Args:
        agent: The agent that steers.
        n_robots: Number of robots.
        seed: Seed of the first; the others have those after it.
        watch: Called now and then with the robots as they are.

    Returns:
        The robots at their ends, and all lateral offsets on the way, m.
    """
    driver = Driver(env, start=_start, add=_add, keep=_keep)
    now = driver.begin(params, agent, seed + np.arange(n_robots, dtype=np.uint32))
    offsets = []
    for last, kept in driver.drive(params, agent, now, _CHUNK):
        now, lateral = last, np.asarray(kept).ravel()
        offsets.append(lateral[~np.isnan(lateral)])
        if watch is not None:
            watch(_walk(now))
    return _walk(now), np.concatenate(offsets)


def _walk(now: Episode) -> Walk:
    success, contact, fall = now.tally
    return jax.device_get(Walk(now.state, now.over, success, contact, fall, now.state.steps))


def _start(state: State, params: EnvParams) -> tuple[Array, Array, Array]:
    no = jnp.zeros((), bool)
    return no, no, no


def _add(now: Episode, taken: Taken, params: EnvParams) -> tuple[tuple[Array, Array, Array], Array]:
    flags = (taken.info["success"], taken.info["contact"], taken.info["fall"])
    return flags, taken.terminated | taken.truncated


def _keep(now: Episode, taken: Taken, params: EnvParams) -> Float[Array, ""]:
    """Keep the lateral offset, m; NaN once the episode is over."""
    return jnp.where(now.over, jnp.nan, taken.after.lateral)


def figures(now: Walk, lateral: Float[np.ndarray, "n"], params: EnvParams) -> dict[str, float]:
    """Compute the figures of a trial: percentages of robots, tunnel and distance, speed (m/s) and offset (m)."""
    begun, period, length = (float(np.asarray(x)) for x in (
        params.start.station, params.vehicle.period, params.tunnel.length
    ))  # fmt: skip
    walked = np.asarray(now.state.station) - begun
    error = (np.asarray(now.state.odometry.distance) - walked) / np.maximum(walked, 1.0)
    share = 100.0 / len(now.over)
    return {
        "robots": float(len(now.over)),
        "success_percent": share * float(np.sum(now.success)),
        "fall_percent": share * float(np.sum(now.fall)),
        "contact_percent": share * float(np.sum(now.contact)),
        "coverage_median_percent": 100.0 * float(np.median(now.state.furthest)) / length,
        "speed_mean": float(np.mean(walked / (np.asarray(now.steps) * period))),
        "lateral_rms": float(np.sqrt(np.mean(np.square(lateral)))),
        "odometer_error_percent": 100.0 * float(np.mean(error)),
        "odometer_error_sigma_percent": 100.0 * float(np.std(error)),
    }
