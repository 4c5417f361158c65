"""Trainers of other libraries on our adapters, one file each to copy from, and the watch that times them all.

An example trains the task that its watch names until the watch says that it is enough: `train(watch, steps, seed)`.
"""
