"""Bore in, files out: meshes, planar tunnel, track, MJCF and manifest."""
