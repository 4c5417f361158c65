"""The numbers that define the benchmark, in one place.

Params take their defaults from here, and `subterra_jax.tasks` the tasks' own figures. Whoever changes one makes another
benchmark: `tasks.constants_digest` changes with it, stands in every result, and is pinned by a test.

Sources: the paper gives the limits of the two velocities, the beams, range and noise of the LiDAR, the part to cover,
the form of Eq. 1 and its terminal reward of 1, and names the odometer's two errors without sizes. It gives neither
period nor radius of the robot, nor horizon, nor the weights g, c_d and c_s. These and all other figures are ours; those
of the errors are chosen so that dead reckoning alone fails.
"""

# Robot: a round unicycle.
SPEED_MAX, YAW_RATE_MAX = 2.0, 1.5  # m/s, rad/s; the paper's
RADIUS = 0.4  # m
PERIOD = 0.1  # s, of control

# Planar LiDAR; all the paper's.
RANGE_MAX, RANGE_SIGMA, N_BEAMS = 30.0, 0.05, 16  # m, m, 1

# Odometer: noise of one step, error that lasts an episode, error that wanders over the distance.
DISTANCE_SIGMA, DISTANCE_BIAS_SIGMA = 0.01, 0.02  # m, 1
HEADING_SIGMA, HEADING_BIAS_SIGMA = 0.001, 0.002  # rad, rad/s
ODOMETER_WANDER_SIGMA, WANDER_LENGTH = 0.01, 30.0  # 1, m; from T1 on
BACKWARD_BIAS_SIGMA = 0.02  # 1; from T1 on

# Slip between command and motion, from T1 on.
SLIP_GAIN_SIGMA, SLIP_YAW_SIGMA, SLIP_WANDER_SIGMA = 0.02, 0.002, 0.02  # 1, rad/s, 1

# Start of an episode; of a hidden one, the standard deviation of the true station about the reported one.
START_LATERAL, START_HEADING = 0.5, 0.1  # m, rad; uniform to either side
HIDDEN_START_SIGMA = 3.0  # m

# Success.
GOAL_COVERAGE = 0.9  # of the tunnel; T0; the paper's
# From T1 on, starts and goals lie further from a mouth than the LiDAR reaches, hidden start and drift included; goals
# are distances from the start. In T5 the margin is more than the reach and the travel together.
GOAL_LOW, GOAL_HIGH, GOAL_MARGIN = 60.0, 320.0, 40.0  # m
TOLERANCE = 1.0  # m
STILL_SPEED, STILL_YAW, STILL_STEPS = 0.05, 0.5, 10  # m/s, rad/s, steps
FLAG_REACH = 2.0  # m; T2
TRAVEL_MAX = 120.0  # m; default of the params, which T5 alone reads and sets
RELOCALISE_MARGIN, RELOCALISE_TRAVEL = 95.0, 60.0  # m; T5

# Short variants, for laptops: a stretch of the tunnel in T0, near goals in T1.
SHORT_LENGTH = 60.0  # m
SHORT_GOAL_LOW, SHORT_GOAL_HIGH, SHORT_TOLERANCE = 10.0, 60.0, 0.25  # m

# Horizons, steps.
HORIZON_TRAVERSE, HORIZON_STOP, HORIZON_RETURN, HORIZON_RELOCALISE = 3000, 4000, 8000, 2000
HORIZON_TRAVERSE_SHORT, HORIZON_STOP_SHORT = 600, 1000

# Reward of T0, the paper's Eq. 1; the terminal reward is the paper's.
REWARD_TERMINAL, REWARD_COVERAGE, REWARD_LATERAL, REWARD_JERK = 1.0, 100.0, 0.1, 0.01

# Reward of the tasks with a goal.
GOAL_TERMINAL, GOAL_PRECISION, GOAL_MISS, GOAL_CRASH = 4.0, 4.0, 0.05, 1.0
GOAL_PROGRESS, GOAL_TIME, GOAL_LATERAL, GOAL_JERK = 0.05, 0.002, 0.01, 0.003

# Boxes of T3.
BOX_PITCH = 15.0  # m of tunnel for each box
BOX_SIZE_MIN, BOX_SIZE_MAX = 0.3, 0.8  # m
BOX_GAP, BOX_FIRST = 1.2, 8.0  # m; the latter from the start
TROLLEY_LENGTH, TROLLEY_WIDTH = 2.4, 1.2  # m

# Faults of T4 at the highest severity. Each size is drawn for an episode between 1 - spread and 1 + spread times its
# middle, given here.
SEVERITY_LOW, SEVERITY_HIGH = 0, 4
DROPOUT_RATE, DROPOUT_FRACTION, DROPOUT_STEPS = 0.02, 0.5, 40.0  # per step, of the beams, steps
DUST_RATE = 0.15  # per beam
FREEZE_RATE, FREEZE_STEPS = 0.01, 30.0  # per step, steps
DELAY = 2.4  # steps
WET_PATCH, WET_FRACTION, WET_LOSS = 10.0, 0.3, 0.3  # m, of the patches, of the speed
FAULT_SPREAD = 2.0 / 3.0
# Odometers do not begin at 0 in T4, or the first reading would tell the delay.
ORIGIN_DISTANCE_SIGMA, ORIGIN_HEADING_SIGMA = 0.05, 0.005  # m, rad

# LiDARs in three dimensions: range noise, what each metre and each unit of the tangent of incidence add to it, returns
# lost, fraction of mixed pixels where these are asked for.
SPATIAL_SIGMA, SPATIAL_SIGMA_PER_METRE, SPATIAL_SIGMA_SLANT = 0.019, 1e-4, 0.002  # m, m/m, m
SPATIAL_LOST, SPATIAL_MIXED = 0.004, 0.1  # 1, 1
SPATIAL_HEIGHT = 0.7  # m above the ground

# IMU, where one is asked for: noise densities, random walks of the biases, and first biases.
IMU_ACCEL_DENSITY, IMU_GYRO_DENSITY = 5.574e-3, 5.144e-3  # m/s²/√Hz, rad/s/√Hz
IMU_ACCEL_WALK, IMU_GYRO_WALK = 1.208e-4, 1.088e-4  # m/s²/√s, rad/s/√s
IMU_ACCEL_BIAS, IMU_GYRO_BIAS = 0.02, 0.003  # m/s², rad/s
