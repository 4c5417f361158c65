"""SLAM programs on recorded episodes: recordings to run them on, a scorer of their poses, and libraries of today."""
