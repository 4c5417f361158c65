"""Our PPO beside that of Stable-Baselines3, on the same task and in the same units.

curve (finished episodes by steps and seconds) ─► stable_baselines, ours ─► report (when the goal was met, figure)
"""
