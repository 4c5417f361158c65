"""Learnt localisers without a map: what beams ahead saw is looked for by beams behind, which tells the true distance.

scan ─► points on the walls ─► profile of each beam over the commanded distance ─► evidence per metre ─► memory

Inputs are ranges, odometry, commands and the walls that the steering tracks; no counter of rings, no ring length.
"""
