"""Scores a reconstruction: 18 categories, 199 metrics, a verdict that can fail.

scene folder ─► candidate ┐
held-out recording ┐      ├─► case ─► categories/ ─► values ─► scoring ─► report/
truth or control   ┴─► references ┘
"""

from subterra_jax.host.command import require_libraries

require_libraries(
    "benchmarks.fidelity", "fidelity,recordings", "sklearn", "skimage", "gudhi", "cc3d", "pymeshlab", "py4dgeo",
    "jinja2", "rosbags",
)  # fmt: skip
