"""Recordings for LiDAR-inertial programs, made by the survey's simulator, and a dial of degeneracy.

walls (bores) + drives (motion) + dust ─► record (sweeps, IMU, wheels) ─► bags (ROS 2 MCAP, ROS 1) ─► sets (folders)
"""
