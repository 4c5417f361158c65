"""What describes an environment: params (what the task is), state (what changes) and the random numbers of a call.

A part that a task does not have is None in params, state and noise alike, and costs nothing.
"""

from flax import struct
from jaxtyping import Array, Float, Int, UInt32

from subterra_jax.faults import FaultParams, FaultState
from subterra_jax.lidar import LidarParams
from subterra_jax.obstacles import ObstacleParams
from subterra_jax.odometry import OdometryParams, OdometryState
from subterra_jax.reward import GoalRewardParams, RewardParams
from subterra_jax.slip import SlipParams, SlipState
from subterra_jax.tunnel import Tunnel
from subterra_jax.vehicle import VehicleParams


@struct.dataclass
class StartParams:
    """Where an episode begins.

    Attributes:
        station: Station of the start, m; 0 is the mouth.
        lateral: Largest offset from the centreline to either side, m; drawn uniformly.
        heading: Largest angle to the centreline to either side, rad; drawn uniformly.
        station_sigma: Standard deviation of the true start about `station`, m, cut off at three of them. Only tasks
            with a goal draw it; `odometry` reads 0 there all the same.
    """

    station: float = 0.0
    lateral: float = 0.5
    heading: float = 0.1
    station_sigma: float = 0.0


@struct.dataclass
class GoalParams:
    """What is to be reached, and what counts as having reached it.

    Attributes:
        low: Least chainage of a goal, m.
        high: Largest chainage of a goal, m.
        margin: Goals, and starts anywhere, keep this far from the ends of the tunnel, m; it comes before `low`.
        tolerance: Largest error of success, m.
        still_speed: A robot slower than this stands, m/s,
        still_yaw: unless it turns faster than this, rad/s: to turn on the spot is not to stop.
        still_steps: Standing for so many steps is a stop, which ends the episode.
        flag_reach: The flag is raised within this distance of the goal, m.
        travel_max: Distance after which a robot that has not reported has failed, m.
    """

    low: float = 60.0
    high: float = 320.0
    margin: float = 5.0
    tolerance: float = 1.0
    still_speed: float = 0.05
    still_yaw: float = 0.5
    still_steps: int = 10
    flag_reach: float = 2.0
    travel_max: float = 120.0


@struct.dataclass
class GoalState:
    """The goal of one episode, and how far it has come.

    Attributes:
        station: Chainage of the goal, m.
        still: Steps that the robot has stood.
        start: True chainage of the start, m, where one is to return to it.
        flag: 1 once the goal has been reached, else 0, where one is to return.
        travelled: True distance driven, m, where that is limited.
    """

    station: Float[Array, ""]
    still: Int[Array, ""]
    start: Float[Array, ""] | None = None
    flag: Float[Array, ""] | None = None
    travelled: Float[Array, ""] | None = None


@struct.dataclass
class EnvParams:
    """Everything about a task that is data. Every leaf may be vmapped.

    Attributes:
        tunnel: The tunnel, or several of which each episode draws one.
        vehicle: The robot.
        lidar: The LiDAR.
        odometry: The odometer.
        reward: Weights of the reward's terms.
        start: Where an episode begins.
        goal_coverage: Share of the tunnel to cover for success, where coverage is the task.
        horizon: Steps after which an episode is truncated.
        slip: Slip of the plant.
        goal: What is to be reached.
        obstacles: Boxes on the way.
        faults: Faults that come and go.
    """

    tunnel: Tunnel
    vehicle: VehicleParams
    lidar: LidarParams
    odometry: OdometryParams
    reward: RewardParams | GoalRewardParams
    start: StartParams
    goal_coverage: float = 0.9
    horizon: int = 3000
    slip: SlipParams | None = None
    goal: GoalParams | None = None
    obstacles: ObstacleParams | None = None
    faults: FaultParams | None = None


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
        tunnel: Which tunnel, where there are several.
        slip: Slip of the plant.
        goal: The goal.
        obstacles: Seed of the boxes.
        faults: Faults.
    """

    position: Float[Array, "2"]
    heading: Float[Array, ""]
    station: Float[Array, ""]
    lateral: Float[Array, ""]
    furthest: Float[Array, ""]
    command: Float[Array, "2"]
    odometry: OdometryState
    steps: Int[Array, ""]
    tunnel: Int[Array, ""] | None = None
    slip: SlipState | None = None
    goal: GoalState | None = None
    obstacles: UInt32[Array, ""] | None = None
    faults: FaultState | None = None


@struct.dataclass
class ResetNoise:
    """Random numbers of one reset.

    Attributes:
        start: Uniform in [-1, 1], for the lateral offset and the heading.
        bias: Standard normal, for the odometer's biases.
        tunnel: Uniform in [0, 1), where there are several tunnels.
        slip: Standard normal, for the slip of the plant.
        goal: Uniform in [0, 1), for the goal, the place and the direction of the start.
        station: Standard normal, for the true start.
        seed: Random bits: `obstacles`, then `faults`.
        severity: Uniform in [0, 1).
    """

    start: Float[Array, "*batch 2"]
    bias: Float[Array, "*batch n_bias"]
    tunnel: Float[Array, "*batch"] | None = None
    slip: Float[Array, "*batch 3"] | None = None
    goal: Float[Array, "*batch 3"] | None = None
    station: Float[Array, "*batch"] | None = None
    seed: UInt32[Array, "*batch 2"] | None = None
    severity: Float[Array, "*batch"] | None = None


@struct.dataclass
class StepNoise:
    """Random numbers of one step.

    Attributes:
        odometry: Standard normal, for the odometer.
        ranges: Standard normal, for the LiDAR.
        slip: Standard normal, for the slip of the plant.
        faults: Uniform in [0, 1), for what fails.
    """

    odometry: Float[Array, "*batch n_odometry"]
    ranges: Float[Array, "*batch n_beams"]
    slip: Float[Array, "*batch 1"] | None = None
    faults: Float[Array, "*batch n_faults"] | None = None
