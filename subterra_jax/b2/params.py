"""What describes the walking task."""

from flax import struct
from jaxtyping import Array

from subterra_jax.b2.gait import GaitParams
from subterra_jax.b2.state import Feeling as Feeling
from subterra_jax.b2.state import WalkResetNoise as WalkResetNoise
from subterra_jax.b2.state import WalkState as WalkState
from subterra_jax.b2.state import WalkStepNoise as WalkStepNoise
from subterra_jax.b2.track import Track
from subterra_jax.tunnel import Tunnel

Range = Array | tuple[float, float]


@struct.dataclass
class CommandParams:
    """The driver in training: draws velocities and keeps the robot between the rails.

    Attributes:
        low: Least velocity forward and to the left (m/s), and yaw rate (rad/s).
        high: Largest.
        hold: Mean time for which a command is held, s; holding times are exponential.
        still: Share of commands that ask to stand.
        corridor: How far from the axis the driver lets the robot stray, m.
    """

    low: Array | tuple[float, float, float] = (-0.4, -0.3, -0.8)
    high: Array | tuple[float, float, float] = (1.2, 0.3, 0.8)
    hold: float = 4.0
    still: float = 0.15
    corridor: float = 0.25


@struct.dataclass
class VarietyParams:
    """How robots differ from one another, and what happens to them. Uniform draws.

    Attributes:
        friction: Of the feet.
        mass: Factor on all masses; down to the data sheet's 60 kg.
        shift: Of the trunk's centre of mass to either side, m.
        gain: Factor on each servo's stiffness and damping.
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
    """Uniform noise to either side of what the robot feels of itself.

    Attributes:
        rate: Of the gyroscope, rad/s.
        gravity: Of each component of gravity's direction.
        angle: Of a joint, rad.
        speed: Of a joint, rad/s.
    """

    rate: float = 0.2
    gravity: float = 0.03
    angle: float = 0.02
    speed: float = 0.5


@struct.dataclass
class WalkRewardParams:
    """Weights of the reward's terms; each is paid per second, but for the fall, which is paid once.

    Attributes:
        velocity: exp(-error²/width²) of the velocity in plan.
        yaw_rate: The same of the yaw rate.
        width: m/s and rad/s.
        alive: For not having fallen.
        bounce: Square of the trunk's vertical velocity, m²/s².
        roll: Square of its rates of roll and pitch, rad²/s².
        tilt: Square of the sine of its tilt.
        effort: Sum of the squares of all torques, N² m².
        jerk: Sum of the squares of the changes of the action from step to step.
        action: Sum of the squares of the action.
        slip: Sum of the squares of the speeds in plan of feet that are meant to stand, m²/s².
        fall: Once.
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
    """Everything about the task that is data.

    Attributes:
        tunnel: The tunnel.
        track: Its track.
        gait: The trot to which the action is added.
        command: The driver.
        variety: How robots differ.
        sensor: What they feel.
        reward: Weights.
        action_scale: Joint offset of an action of 1: hip, thigh, calf, rad.
        horizon: Steps after which an episode is truncated.
        fall_height: A trunk lower than this over the sleepers has fallen, m.
        fall_tilt: A trunk tilted by more has fallen, rad.
    """

    tunnel: Tunnel
    track: Track
    gait: GaitParams
    command: CommandParams
    variety: VarietyParams
    sensor: SensorParams
    reward: WalkRewardParams
    action_scale: Array | tuple[float, float, float] = (0.2, 0.3, 0.3)
    horizon: int = 1000
    fall_height: float = 0.25
    fall_tilt: float = 1.0
