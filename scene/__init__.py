"""A LiDAR recording of a tunnel in, a scene folder out: NumPy on the CPU, deterministic."""
