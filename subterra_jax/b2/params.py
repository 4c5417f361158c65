"""Params, state and random numbers of the walking task."""

import dataclasses

from flax import struct
from jaxtyping import Array, Float, Int

from subterra_jax.b2.gait import GaitParams, GaitState
from subterra_jax.physics.engine import Build
from subterra_jax.physics.ground import Track
from subterra_jax.physics.riding import Ride
from subterra_jax.tunnel import Tunnel

Range = Array | tuple[float, float]


@struct.dataclass
class CommandParams:
    """The velocity commands of training, which keep the robot between the rails.

    Attributes:
        low: Least velocity forward and to the left (m/s), and yaw rate (rad/s).
        high: Largest velocity and yaw rate.
        hold: Mean time for which a command is held, s; holding times are exponential.
        still: Fraction of commands that ask to stand.
        corridor: Largest distance from the axis that commands allow, m.
    """

    low: Array | tuple[float, float, float] = (-0.4, -0.3, -0.8)
    high: Array | tuple[float, float, float] = (1.2, 0.3, 0.8)
    hold: float = 4.0
    still: float = 0.15
    corridor: float = 0.25


@struct.dataclass
class RandomisationParams:
    """Domain randomisation: uniform draws of the robot's properties, and random pushes.

    Attributes:
        friction: Range of the feet's friction.
        mass: Range of the factor on all masses; down to the data sheet's 60 kg.
        shift: Largest shift of the trunk's centre of mass to either side, m.
        gain: Range of the factor on each servo's stiffness and damping.
        push: Largest change of velocity by a push, forward and sideways each, m/s.
        push_every: Mean time between pushes, s.
    """

    friction: Range = (0.4, 1.0)
    mass: Range = (0.8, 1.05)
    shift: Array | tuple[float, float, float] = (0.04, 0.02, 0.02)
    gain: Range = (0.9, 1.1)
    push: float = 0.5
    push_every: float = 5.0


@struct.dataclass
class SensorParams:
    """Largest noise of the proprioceptive sensors, uniform to either side.

    Attributes:
        rate: Noise of the gyroscope, rad/s.
        gravity: Noise of each component of gravity's direction.
        angle: Noise of a joint's angle, rad.
        speed: Noise of a joint's speed, rad/s.
    """

    rate: float = 0.2
    gravity: float = 0.03
    angle: float = 0.02
    speed: float = 0.5


@struct.dataclass
class WalkRewardParams:
    """Weights of the reward terms; each counts per second, except the fall, which counts once.

    Attributes:
        velocity: Weight of exp(-error²/width²) of the velocity in plan.
        yaw_rate: Weight of exp(-error²/width²) of the yaw rate.
        width: Error at which these two have fallen to 1/e, m/s and rad/s.
        alive: Reward for not having fallen.
        bounce: Weight of the square of the trunk's vertical velocity, m²/s².
        roll: Weight of the squares of its rates of roll and pitch, rad²/s².
        tilt: Weight of the square of the sine of its tilt.
        effort: Weight of the sum of the squares of all torques, N² m².
        jerk: Weight of the sum of the squares of the action's changes from step to step.
        action: Weight of the sum of the squares of the action.
        slip: Weight of the sum of the squares of the speeds in plan of feet that should stand, m²/s².
        fall: Reward of a fall, once.
    """

    velocity: float = 2.0
    yaw_rate: float = 1.0
    width: float = 0.25
    alive: float = 0.5
    bounce: float = -1.0
    roll: float = -0.05
    tilt: float = -2.0
    effort: float = -5e-6
    jerk: float = -0.02
    action: float = -0.02
    slip: float = -0.05
    fall: float = -4.0


@struct.dataclass
class WalkParams:
    """All data of the walking task.

    Attributes:
        tunnel: The tunnel.
        track: Its track.
        gait: The trot to which the action is added.
        command: The velocity commands.
        randomisation: The domain randomisation.
        sensor: Noise of proprioception.
        reward: Weights of the reward terms.
        action_scale: Joint offset of an action of 1: hip, thigh, calf, rad.
        horizon: Steps after which an episode is truncated.
        fall_height: Height of the trunk over the sleepers below which it has fallen, m.
        fall_tilt: Tilt of the trunk beyond which it has fallen, rad.
    """

    tunnel: Tunnel
    track: Track
    gait: GaitParams = dataclasses.field(default_factory=GaitParams)
    command: CommandParams = dataclasses.field(default_factory=CommandParams)
    randomisation: RandomisationParams = dataclasses.field(default_factory=RandomisationParams)
    sensor: SensorParams = dataclasses.field(default_factory=SensorParams)
    reward: WalkRewardParams = dataclasses.field(default_factory=WalkRewardParams)
    action_scale: Array | tuple[float, float, float] = (0.2, 0.3, 0.3)
    horizon: int = 1000
    fall_height: float = 0.25
    fall_tilt: float = 1.0


@struct.dataclass
class Proprioception:
    """Readings of the robot's own sensors, with noise."""

    rates: Float[Array, "3"]  # rates of the trunk in its own axes, rad/s
    gravity: Float[Array, "3"]  # direction of gravity in the trunk's axes
    angles: Float[Array, "12"]  # joint angles, rad
    speeds: Float[Array, "12"]  # joint speeds, rad/s
    velocity: Float[Array, "2"]  # smoothed velocity of the trunk from its standing legs, forward and to the left, m/s


@struct.dataclass
class WalkState(Ride):
    """State of one robot."""

    gait: GaitState  # state of the gait
    command: Float[Array, "3"]  # commanded velocity forward and to the left (m/s), and yaw rate (rad/s)
    drawn_command: Float[Array, "3"]  # command as drawn, before it is changed to keep the robot between the rails
    facing: Float[Array, ""]  # 1 towards growing station, -1 the other way
    action: Float[Array, "12"]  # last action
    proprioception: Proprioception  # last readings of its own sensors
    build: Build  # properties of this robot
    furthest: Float[Array, ""]  # largest station so far, m
    steps: Int[Array, ""]  # control periods in this episode


@struct.dataclass
class WalkResetNoise:
    """Random numbers of one reset: uniform in [-1, 1)."""

    place: Float[Array, "*batch 5"]  # for station, lateral offset, heading, direction faced, clock of the gait
    build: Float[Array, "*batch 29"]  # for friction, mass, shift (3), stiffness (12), damping (12)
    command: Float[Array, "*batch 4"]  # for the first command (3), and for standing
    sensor: Float[Array, "*batch 30"]  # sensor noise, as in a step


@struct.dataclass
class WalkStepNoise:
    """Random numbers of one step: uniform in [-1, 1)."""

    sensor: Float[Array, "*batch 30"]  # noise of rates, gravity, angles and speeds
    command: Float[Array, "*batch 5"]  # for a new command (3), for standing, and for its arrival
    push: Float[Array, "*batch 3"]  # for a push (2), and for its arrival
