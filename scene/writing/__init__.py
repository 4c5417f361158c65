"""From the bore to files: meshes, planar tunnel, track and MJCF."""
