"""Our PPO beside that of Stable-Baselines3, on the same task and in the same units.

runs (train both; finished episodes by steps and seconds) ─► __main__ (table, JSON, figure)
"""
