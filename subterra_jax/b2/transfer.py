"""Navigation from wheels to legs: a planar stand-in on which it is cheap to learn, and the trial on many robots.

The stand-in obeys late and nods, as the walking robot does.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.agent import Agent, observed
from subterra_jax.episode import Driver, Episode, Taken
from subterra_jax.evaluation import Episodes
from subterra_jax.lidar import bearings, scan
from subterra_jax.parts import Noise, PlanarLidar, SensingState, Unicycle
from subterra_jax.parts.unicycle import clip_action
from subterra_jax.physics.riding import mean_motion
from subterra_jax.physics.rotations import inverse, rotate
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel_env import TunnelEnv

_CHUNK = 25  # steps between two looks at whether any robot is still on its way
_EVERY = 5  # steps from one that is kept to the next


@dataclasses.dataclass(frozen=True)
class LaggedWheels(Unicycle):
    """A robot that follows its commands through two first-order lags.

    The defaults were identified from the released gait: 900 steps of six robots in MuJoCo, steered along the
    centreline with noisy commands. `State.command` is the motion of the robot, so that the reward's jerk is that of its
    motion.
    """

    lag: tuple[float, float] = (0.38, 0.24)  # time constants of forward speed and yaw rate, s
    gain: tuple[float, float] = (1.01, 1.07)  # final speed and yaw rate over a lasting command

    def obey(self, action: Float[Array, "n_action"], state: State, params: EnvParams) -> Float[Array, "2"]:
        """Follow the clipped command, late."""
        target = clip_action(action[:2], params.vehicle) * jnp.array(self.gain)
        fraction = 1.0 - jnp.exp(-jnp.asarray(params.vehicle.period) / jnp.array(self.lag))
        return clip_action(state.command + fraction * (target - state.command), params.vehicle)


@dataclasses.dataclass(frozen=True)
class NoddingLidar(PlanarLidar):
    """A planar LiDAR that leans with the trunk, at random in each step: beams that point down end on the ballast."""

    lean: tuple[float, float, float] = (0.03, 0.04, 0.03)  # mean pitch, nose down, and σ of pitch and roll, rad
    height: float = 0.75  # height of the LiDAR over the ballast, m

    def normals(self, params: EnvParams) -> int:
        """One for each beam, then pitch and roll."""
        return super().normals(params) + 2

    def observe(self, own: Any, sensing: SensingState, noise: Noise, params: EnvParams) -> dict[str, Array]:
        """Return noisy `ranges`, m."""
        n_beams, (pitch, pitch_sigma, roll_sigma) = params.lidar.n_beams, self.lean
        seen = super().observe(own, sensing, Noise(noise.normal[:n_beams]), params)["ranges"]
        bearing = jnp.asarray(bearings(n_beams), jnp.float32)
        pitch = pitch + pitch_sigma * noise.normal[n_beams]
        roll = roll_sigma * noise.normal[n_beams + 1]
        sinking = jnp.sin(pitch) * jnp.cos(bearing) - jnp.sin(roll) * jnp.sin(bearing)
        ground = jnp.where(sinking > 1e-3, self.height / jnp.maximum(sinking, 1e-3), jnp.inf)
        return {"ranges": jnp.minimum(seen, ground)}


def stand_in(env: TunnelEnv, motion: Unicycle = LaggedWheels(), lidar: PlanarLidar = NoddingLidar()) -> TunnelEnv:
    """Make the planar stand-in of the walking robot: the same task on wheels that lag, with a LiDAR that nods."""
    parts = tuple(lidar if part.name == PlanarLidar.name else part for part in env.parts)
    return dataclasses.replace(env, motion=motion, parts=parts)


@struct.dataclass
class Walk:
    """Robots at their ends."""

    state: State  # state of the environment
    over: Bool[Array, "*n"]  # the robot has arrived or failed
    success: Bool[Array, "*n"]  # the robot has arrived
    contact: Bool[Array, "*n"]  # the robot touched a wall
    fall: Bool[Array, "*n"]  # the robot fell
    start: Float[Array, "*n"]  # station of its start, m


@struct.dataclass
class Row:
    """One step of a robot on its way; NaN once it is over."""

    lateral: Float[Array, "*n"]  # lateral offset, m
    command: Float[Array, "*n 2"]  # speed (m/s) and yaw rate (rad/s) as commanded
    motion: Float[Array, "*n 2"]  # those that it had
    lean: Float[Array, "*n 2"]  # pitch and roll against the track, rad; 0 on the plan
    sway: Float[Array, "*n n_beams"]  # its ranges less those of a level LiDAR without noise, m


def walk_robots(
    env: TunnelEnv,
    params: EnvParams,
    agent: Agent,
    episodes: Episodes,
    watch: Callable[[Walk], None] | None = None,
) -> tuple[Walk, Row]:
    """Let robots drive episodes until all have arrived or failed.

    Args:
        agent: The agent that steers.
        episodes: An episode for each robot.
        watch: Called now and then with the robots as they are.

    Returns:
        The robots at their ends; and every `_EVERY`-th step, `(steps, n, ...)`.
    """
    driver = Driver(env, start=_start, add=_add, keep=_Keep(env))
    now = driver.begin(params, agent, episodes.seed, episodes.tunnel, episodes.severity)
    rows = []
    for last, kept in driver.drive(params, agent, now, _CHUNK):
        now = last
        rows.append(jax.tree.map(lambda leaf: np.asarray(leaf)[::_EVERY], kept))
        if watch is not None:
            watch(_walk(now))
    return _walk(now), jax.tree.map(lambda *parts: np.concatenate(parts), *rows)


def _walk(now: Episode) -> Walk:
    success, contact, fall, start = now.tally
    return jax.device_get(Walk(now.state, now.over, success, contact, fall, start))


def _start(state: State, params: EnvParams) -> tuple[Array, Array, Array, Array]:
    no = jnp.zeros((), bool)
    return no, no, no, state.station


def _add(now: Episode, taken: Taken, params: EnvParams) -> tuple[tuple[Array, Array, Array, Array], Array]:
    fall = taken.info.get("fall", jnp.zeros((), bool))
    flags = (taken.info["success"], taken.info["contact"], fall, now.tally[3])
    return flags, taken.terminated | taken.truncated


@dataclasses.dataclass(frozen=True)
class _Keep:
    env: TunnelEnv

    def __call__(self, now: Episode, taken: Taken, params: EnvParams) -> Row:
        before, after = taken.before, taken.after
        motion: Any = self.env.motion
        level = scan(params.tunnel, before.position, before.heading, before.station, params.lidar, True)
        lean = jnp.zeros(2)
        if not motion.on_the_plan:
            ride = after.parts[motion.name]
            up = rotate(inverse(ride.body.qpos[3:7]), rotate(params.track.quaternion[ride.anchor], jnp.eye(3)[2]))
            lean = jnp.arctan2(jnp.stack([-up[0], up[1]]), up[2])
        row = Row(
            lateral=after.lateral,
            command=after.command,
            motion=mean_motion(before, after.position, after.heading, params),
            lean=lean,
            sway=observed(self.env, params, taken.observation).ranges - level,
        )
        return jax.tree.map(lambda leaf: jnp.where(now.over, jnp.nan, leaf), row)


def figures(now: Walk, rows: Row, params: EnvParams) -> dict[str, float]:
    """Compute the figures of a trial, by name with their units.

    `obeyed` is what a robot does of its command, its σ that between robots; `range_off` the spread of ranges about
    those of a level LiDAR, whose noise is 0.05 m.
    """
    period, lengths = float(np.asarray(params.vehicle.period)), np.atleast_1d(np.asarray(params.tunnel.length))
    state, n = now.state, len(now.over)
    walked = np.asarray(state.station) - now.start
    error = (np.asarray(state.odometry.distance) - np.abs(walked)) / np.maximum(np.abs(walked), 1.0)
    commanded, done = (np.nan_to_num(part) for part in (rows.command, rows.motion))
    total = np.sum(commanded * commanded, axis=0)
    obeyed = np.where(total > 0.0, np.sum(commanded * done, axis=0) / np.maximum(total, 1e-9), np.nan)
    off = np.abs(rows.sway[np.isfinite(rows.sway)])
    spread = np.rad2deg(np.nanstd(rows.lean, axis=(0, 1)))
    return {
        "robots": float(n),
        "success_percent": 100.0 * float(np.mean(now.success)),
        "fall_percent": 100.0 * float(np.mean(now.fall)),
        "contact_percent": 100.0 * float(np.mean(now.contact)),
        "coverage_median_percent": 100.0 * float(np.median(state.furthest / lengths[state.tunnel])),
        "speed_mean": float(np.mean(walked / (np.asarray(state.steps) * period))),
        "lateral_rms": float(np.sqrt(np.nanmean(np.square(rows.lateral)))),
        "odometer_error_percent": 100.0 * float(np.mean(error)),
        "odometer_error_sigma_percent": 100.0 * float(np.std(error)),
        "speed_obeyed_percent": 100.0 * float(np.nanmean(obeyed[:, 0])),
        "speed_obeyed_sigma_percent": 100.0 * float(np.nanstd(obeyed[:, 0])),
        "yaw_obeyed_percent": 100.0 * float(np.nanmean(obeyed[:, 1])),
        "pitch_sigma_deg": float(spread[0]),
        "roll_sigma_deg": float(spread[1]),
        "range_off_rms": float(np.sqrt(np.mean(off**2))),
        "range_off_p95": float(np.quantile(off, 0.95)),
    }
