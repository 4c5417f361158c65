"""A LiDAR recording of a tunnel in, a scene folder out: NumPy on the CPU, deterministic."""

from scene.extras import require

require(
    "scene", "recordings", "tyro", "rich", "rosbags", "small_gicp", "laspy", "shapely", "manifold3d", "embreex", "rtree"
)
