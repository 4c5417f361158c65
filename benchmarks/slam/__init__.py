"""SLAM programs on recorded episodes.

recordings (sets, sweeps) ─► run (libraries of today, wheel odometry) ─► tracks (TUM files, axis) ─► score
"""
