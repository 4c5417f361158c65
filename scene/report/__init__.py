"""Takeaways for surveyors from a built scene: table, alignment, sections, clearance, in the formats that they use."""

from subterra_jax.host.command import require_libraries

require_libraries("scene.report", "survey", "ezdxf", "matplotlib", "openpyxl", "tifffile")
