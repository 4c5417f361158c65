"""The walking robot as seen by who steers it: a planar one that obeys late and nods. Cheap enough to learn on."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax import vehicle
from subterra_jax.env import Info, TunnelEnv
from subterra_jax.lidar import bearings
from subterra_jax.state import EnvParams, State, StepNoise


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


@struct.dataclass(kw_only=True)
class NodNoise(StepNoise):
    """Random numbers of one step.

    Attributes:
        lean: Standard normal, for pitch and roll.
    """

    lean: Float[Array, "*batch 2"]


@dataclasses.dataclass(frozen=True)
class LaggedEnv(TunnelEnv):
    """`TunnelEnv` whose robot follows its commands through two first-order lags, and whose LiDAR leans with its trunk.

    `State.command` is what the robot is doing, so that the reward's jerk is that of its motion.

    Attributes:
        lag: Of the robot.
        nod: Of its trunk.
    """

    lag: Lag = Lag()
    nod: Nod = Nod()

    def draw_step(self, key: PRNGKeyArray, batch: tuple[int, ...], params: EnvParams) -> NodNoise:
        """Random numbers for one step of a batch; row i does not depend on the size of the batch."""
        noise = super().draw_step(key, batch, params)
        return NodNoise(**vars(noise), lean=jax.random.normal(jax.random.fold_in(key, 3), (*batch, 2)))

    def observe(
        self, state: State, noise: StepNoise, params: EnvParams, wanted: Bool[Array, ""] | bool = True
    ) -> Float[Array, "n_obs"]:
        """The observation of a state, in which beams that point down end on the ballast."""
        assert isinstance(noise, NodNoise)
        seen = super().observe(state, noise, params, wanted)
        n_beams = params.lidar.n_beams
        bearing = jnp.asarray(bearings(n_beams), jnp.float32)
        pitch = self.nod.pitch + self.nod.pitch_sigma * noise.lean[0]
        roll = self.nod.roll_sigma * noise.lean[1]
        sinking = jnp.sin(pitch) * jnp.cos(bearing) - jnp.sin(roll) * jnp.sin(bearing)
        ground = jnp.where(sinking > 1e-3, self.nod.height / jnp.maximum(sinking, 1e-3), jnp.inf)
        return seen.at[:n_beams].min(ground)

    def advance(
        self, state: State, action: Float[Array, "n_action"], noise: StepNoise, params: EnvParams
    ) -> tuple[State, Float[Array, ""], Bool[Array, ""], Bool[Array, ""], Info]:
        """Everything of a step but the scan; see `TunnelEnv.advance`."""
        lag, period = self.lag, jnp.asarray(params.vehicle.period)
        wanted = vehicle.clip_action(action[:2], params.vehicle) * jnp.array([lag.speed_gain, lag.yaw_rate_gain])
        share = 1.0 - jnp.exp(-period / jnp.array([lag.speed, lag.yaw_rate]))
        moving = state.command + share * (wanted - state.command)
        return super().advance(state, jnp.concatenate([moving, action[2:]]), noise, params)


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
