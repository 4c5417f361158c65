"""What describes an environment: params (what the task is), state (what changes) and the random numbers of a call."""

from flax import struct
from jaxtyping import Array, Float, Int

from subterra_jax.lidar import LidarParams
from subterra_jax.odometry import OdometryParams, OdometryState
from subterra_jax.reward import RewardParams
from subterra_jax.tunnel import Tunnel
from subterra_jax.vehicle import VehicleParams


@struct.dataclass
class StartParams:
    """Where an episode begins.

    Attributes:
        station: Station of the start, m; 0 is the mouth.
        lateral: Largest offset from the centreline to either side, m; drawn uniformly.
        heading: Largest angle to the centreline to either side, rad; drawn uniformly.
    """

    station: float = 0.0
    lateral: float = 0.5
    heading: float = 0.1


@struct.dataclass
class EnvParams:
    """Everything about a task that is data. Every leaf may be vmapped.

    Attributes:
        tunnel: The tunnel.
        vehicle: The robot.
        lidar: The LiDAR.
        odometry: The odometer.
        reward: Weights of the reward's terms.
        start: Where an episode begins.
        goal_coverage: Share of the tunnel to cover for success.
        horizon: Steps after which an episode is truncated.
    """

    tunnel: Tunnel
    vehicle: VehicleParams
    lidar: LidarParams
    odometry: OdometryParams
    reward: RewardParams
    start: StartParams
    goal_coverage: float = 0.9
    horizon: int = 3000


@struct.dataclass
class State:
    """State of one environment. It holds no key: randomness comes with each call.

    Attributes:
        position: Position in the tunnel frame, m.
        heading: Heading in the tunnel frame, rad, in [-π, π].
        station: Station, m.
        lateral: Distance to the left of the centreline, m.
        furthest: Furthest station reached so far, m.
        command: Last command obeyed, m/s and rad/s.
        odometry: The odometer.
        steps: Steps taken in this episode.
    """

    position: Float[Array, "2"]
    heading: Float[Array, ""]
    station: Float[Array, ""]
    lateral: Float[Array, ""]
    furthest: Float[Array, ""]
    command: Float[Array, "2"]
    odometry: OdometryState
    steps: Int[Array, ""]


@struct.dataclass
class ResetNoise:
    """Random numbers of one reset.

    Attributes:
        start: Uniform in [-1, 1], for the lateral offset and the heading.
        bias: Standard normal, for the odometer's biases.
    """

    start: Float[Array, "*batch 2"]
    bias: Float[Array, "*batch 2"]


@struct.dataclass
class StepNoise:
    """Random numbers of one step, standard normal.

    Attributes:
        odometry: For the odometer.
        ranges: For the LiDAR.
    """

    odometry: Float[Array, "*batch 2"]
    ranges: Float[Array, "*batch n_beams"]
