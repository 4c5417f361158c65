"""Poses of the sensor: given trajectories, odometry, inertia and control; and the cloud that follows."""
