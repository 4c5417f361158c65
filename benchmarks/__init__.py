"""Everything that scores: speed, fidelity and the demo."""

from scene.extras import require

_SURVEYS = tuple(f"benchmarks.{name}" for name in ("demo", "paper", "rays", "reconstruction", "reproduce", "truth"))

require("benchmarks", "train", "tyro", "rich", "matplotlib", "orbax.checkpoint", "safetensors", "PIL")
require(_SURVEYS, "recordings", "rosbags", "small_gicp", "shapely", "manifold3d", "embreex", "rtree")
