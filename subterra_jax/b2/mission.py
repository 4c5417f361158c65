"""What describes a task that the B2 does on its legs: the planar task's params, state and noise, and the robot's."""

from flax import struct
from jaxtyping import Array, Float

from subterra_jax.b2.params import WalkParams, WalkResetNoise, WalkState, WalkStepNoise
from subterra_jax.b2.policy import WalkPolicy
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.state import EnvParams, ResetNoise, State, StepNoise


@struct.dataclass(kw_only=True)
class MissionParams(EnvParams):
    """`EnvParams`, and what walks.

    Attributes:
        walk: The robot, its gait and its track.
        policy: The trained gait, frozen; None is the trot as it is written down.
        relief: What the LiDAR sees; None lets it look at the planar tunnel, whose walls stand upright.
    """

    walk: WalkParams
    policy: WalkPolicy | None = None
    relief: Relief | None = None


@struct.dataclass(kw_only=True)
class MissionState(State):
    """`State` of the trunk's middle, seen from above, and the robot's own.

    Attributes:
        walk: The robot.
    """

    walk: WalkState


@struct.dataclass(kw_only=True)
class MissionResetNoise(ResetNoise):
    """Random numbers of one reset.

    Attributes:
        walk: The robot's.
    """

    walk: WalkResetNoise


@struct.dataclass(kw_only=True)
class MissionStepNoise(StepNoise):
    """Random numbers of one step.

    Attributes:
        walk: The robot's, one set for each of its control periods.
    """

    walk: WalkStepNoise


@struct.dataclass
class Tread:
    """What comes of the control periods of one step.

    Attributes:
        distance: By the legs' own account, m.
        turn: By the gyroscope's, rad.
        clearance: The least, m.
        contact: 1 where a wall was touched, else 0.
        fall: 1 where the robot fell, else 0.
    """

    distance: Float[Array, ""]
    turn: Float[Array, ""]
    clearance: Float[Array, ""]
    contact: Float[Array, ""]
    fall: Float[Array, ""]
