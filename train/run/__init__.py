"""A run on the host: its folder, log, checkpoints, curve of episodes and what an iteration tells of it."""
