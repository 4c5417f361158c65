"""PPO without memory: networks over stacked observations, the unroll, and the epochs that learn from it."""
