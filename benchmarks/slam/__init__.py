"""SLAM programs on recorded episodes.

arena (drives as bags) ─► board (programs of today, wheel odometry) ─► tracks (TUM files, axis) ─► score
"""
