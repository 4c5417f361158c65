"""The walking robot as seen by who steers it: a planar one that obeys late and nods. Cheap enough to learn on."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax.env import TunnelEnv
from subterra_jax.lidar import bearings
from subterra_jax.parts import Noise, PlanarLidar, Sight, Unicycle
from subterra_jax.parts.unicycle import clip_action
from subterra_jax.state import EnvParams, State


@dataclasses.dataclass(frozen=True)
class Lag:
    """First-order lags of speed and yaw rate.

    The defaults are what `identify` found of the released gait: 900 steps of six robots in MuJoCo, steered along the
    centreline by commands to which noise was added.

    Attributes:
        speed: Time constant of the forward speed, s.
        yaw_rate: Time constant of the yaw rate, s.
        speed_gain: Speed that a lasting command comes to, over the command, 1.
        yaw_rate_gain: The same of the yaw rate, 1.
    """

    speed: float = 0.38
    yaw_rate: float = 0.24
    speed_gain: float = 1.01
    yaw_rate_gain: float = 1.07


@dataclasses.dataclass(frozen=True)
class Nod:
    """How the trunk leans, anew in each step: beams that point down end on the ballast.

    Attributes:
        pitch: Mean, nose down, rad.
        pitch_sigma: Standard deviation, rad.
        roll_sigma: The same to the sides, rad.
        height: Of the LiDAR over the ballast, m.
    """

    pitch: float = 0.03
    pitch_sigma: float = 0.04
    roll_sigma: float = 0.03
    height: float = 0.75


@dataclasses.dataclass(frozen=True)
class LaggedWheels(Unicycle):
    """A robot that follows its commands through two first-order lags.

    `State.command` is the motion of the robot, so that the reward's jerk is that of its motion.

    Attributes:
        lag: The lags.
    """

    lag: Lag = Lag()

    def obey(self, action: Float[Array, "n_action"], state: State, params: EnvParams) -> Float[Array, "2"]:
        """Follow the clipped command, late."""
        lag, period = self.lag, jnp.asarray(params.vehicle.period)
        target = clip_action(action[:2], params.vehicle) * jnp.array([lag.speed_gain, lag.yaw_rate_gain])
        share = 1.0 - jnp.exp(-period / jnp.array([lag.speed, lag.yaw_rate]))
        return clip_action(state.command + share * (target - state.command), params.vehicle)


@dataclasses.dataclass(frozen=True)
class NoddingLidar(PlanarLidar):
    """A planar LiDAR that leans with the trunk: beams that point down end on the ballast.

    Attributes:
        nod: How the trunk leans.
    """

    nod: Nod = Nod()

    def normals(self, params: EnvParams) -> int:
        """One for each beam, then pitch and roll."""
        return super().normals(params) + 2

    def observe(self, own: Any, sight: Sight, noise: Noise, params: EnvParams) -> dict[str, Array]:
        """Return noisy `ranges`, m."""
        n_beams, nod = params.lidar.n_beams, self.nod
        seen = super().observe(own, sight, Noise(noise.normal[:n_beams]), params)["ranges"]
        bearing = jnp.asarray(bearings(n_beams), jnp.float32)
        pitch = nod.pitch + nod.pitch_sigma * noise.normal[n_beams]
        roll = nod.roll_sigma * noise.normal[n_beams + 1]
        sinking = jnp.sin(pitch) * jnp.cos(bearing) - jnp.sin(roll) * jnp.sin(bearing)
        ground = jnp.where(sinking > 1e-3, nod.height / jnp.maximum(sinking, 1e-3), jnp.inf)
        return {"ranges": jnp.minimum(seen, ground)}


def stand_in(env: TunnelEnv, lag: Lag = Lag(), nod: Nod = Nod()) -> TunnelEnv:
    """Make the planar stand-in of the walking robot: the same task on wheels that lag, with a LiDAR that nods.

    Args:
        env: A planar task.
        lag: Lags of the robot.
        nod: How its trunk leans.
    """
    parts = tuple(NoddingLidar(nod) if part.name == PlanarLidar.name else part for part in env.parts)
    return dataclasses.replace(env, motion=LaggedWheels(lag), parts=parts)


def identify(commands: Float[np.ndarray, "n 2"], motions: Float[np.ndarray, "n 2"], period: float) -> Lag:
    """Lags and gains that explain a run.

    Args:
        commands: Speed (m/s) and yaw rate (rad/s) asked for in each step.
        motions: What the robot did in each.
        period: Length of a step, s.

    Returns:
        Least squares of `y[k] = a y[k-1] + b u[k]`: gain b / (1 - a), time constant -period / ln a.

    Raises:
        ValueError: A command was never varied, or the motion does not follow it.
    """
    found = []
    for name, u, y in zip(("speed", "yaw rate"), commands.T, motions.T, strict=True):
        design = np.column_stack([y[:-1], u[1:]])
        (a, b), _, rank, _ = np.linalg.lstsq(design, y[1:], rcond=None)
        if rank < 2 or not 0.0 < a < 1.0 or b <= 0.0:
            raise ValueError(f"the {name} does not follow its command: y[k] = {a:.3g} y[k-1] + {b:.3g} u[k]")
        found.append((-period / np.log(a), b / (1.0 - a)))
    (speed, speed_gain), (yaw_rate, yaw_rate_gain) = found
    return Lag(float(speed), float(yaw_rate), float(speed_gain), float(yaw_rate_gain))
