"""What changes while the robot walks, and the random numbers of a call."""

from flax import struct
from jaxtyping import Array, Float, Int

from subterra_jax.b2.gait import GaitState
from subterra_jax.b2.physics import Body, Build


@struct.dataclass
class Feeling:
    """What the robot feels of itself, with noise.

    Attributes:
        rates: Of the trunk in its own axes, rad/s.
        gravity: Direction of gravity in the trunk's axes.
        angles: Of the joints, rad.
        speeds: Of the joints, rad/s.
        velocity: Of the trunk as its standing legs tell, forward and to the left, m/s.
    """

    rates: Float[Array, "3"]
    gravity: Float[Array, "3"]
    angles: Float[Array, "12"]
    speeds: Float[Array, "12"]
    velocity: Float[Array, "2"]


@struct.dataclass
class WalkState:
    """State of one robot. Positions are from the anchor, which keeps them small.

    Attributes:
        body: Physics.
        anchor: Sleeper nearest to the robot.
        gait: The gait.
        command: Velocity forward and to the left (m/s) and yaw rate (rad/s) that are asked for.
        wish: The last command drawn, before the driver keeps the robot between the rails.
        facing: 1 towards growing station, -1 the other way.
        action: The last.
        feeling: What the robot feels.
        build: How it differs.
        furthest: Largest station so far, m.
        steps: Control periods in this episode.
    """

    body: Body
    anchor: Int[Array, ""]
    gait: GaitState
    command: Float[Array, "3"]
    wish: Float[Array, "3"]
    facing: Float[Array, ""]
    action: Float[Array, "12"]
    feeling: Feeling
    build: Build
    furthest: Float[Array, ""]
    steps: Int[Array, ""]


@struct.dataclass
class WalkResetNoise:
    """Random numbers of one reset: uniform in [-1, 1).

    Attributes:
        place: Of station, lateral offset, heading, direction faced, clock of the gait.
        build: Of friction, mass, shift (3), stiffness (12), damping (12).
        command: Of the first command (3) and whether to stand.
        sensor: As in a step.
    """

    place: Float[Array, "*batch 5"]
    build: Float[Array, "*batch 29"]
    command: Float[Array, "*batch 4"]
    sensor: Float[Array, "*batch 30"]


@struct.dataclass
class WalkStepNoise:
    """Random numbers of one step: uniform in [-1, 1).

    Attributes:
        sensor: Of rates, gravity, angles and speeds.
        command: Of a new command (3), whether to stand, and whether it comes.
        push: Of a push (2), and whether it comes.
    """

    sensor: Float[Array, "*batch 30"]
    command: Float[Array, "*batch 5"]
    push: Float[Array, "*batch 3"]
