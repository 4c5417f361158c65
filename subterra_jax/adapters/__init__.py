"""Subterra through other libraries' interfaces: Gymnasium (single and vector), Stable-Baselines3, Brax, Gymnax.

Each file needs its own library, and nothing here is imported until it is asked for.
"""
