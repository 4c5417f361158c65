"""A driven episode as one page for the browser: `python -m subterra_jax.viewer`.

trace (recorder.trace) ─► episode (lines and points) ─┐
plan ─► shapes (walls, floor) ────────────────────────┴► page (viser's player in one HTML file) ◄─ chart
"""
