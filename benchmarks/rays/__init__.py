"""Ranges of the simulator's LiDARs against rays that embree casts in the built mesh."""
