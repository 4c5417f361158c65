"""Everything that scores: speed, fidelity and the demo."""

from subterra_jax.host.command import require_libraries

_SURVEYS = tuple(f"benchmarks.{name}" for name in ("demo", "dirty", "truth"))

require_libraries("benchmarks", "train", "tyro", "rich", "matplotlib", "orbax.checkpoint", "safetensors", "PIL")
require_libraries(_SURVEYS, "recordings", "rosbags", "small_gicp", "shapely", "manifold3d", "embreex", "rtree")
