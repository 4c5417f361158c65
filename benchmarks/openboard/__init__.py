"""Leaderboard of version 1: agents by task, kind of lining and split, each between a floor and a ceiling.

columns (tunnels and episodes of every kind and split) ─► __main__ (drive; one file for each cell) ─► report (tables,
leaks) ─► picture
"""
