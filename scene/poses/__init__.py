"""Where the sensor was: given trajectories, odometry, inertia and control; and the cloud that follows."""
