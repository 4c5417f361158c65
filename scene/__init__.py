"""A LiDAR recording of a tunnel in, a scene folder out: NumPy on the CPU, deterministic."""

from subterra_jax.host.command import require_libraries

require_libraries(
    "scene", "recordings", "tyro", "rich", "rosbags", "small_gicp", "laspy", "shapely", "manifold3d", "embreex", "rtree"
)
