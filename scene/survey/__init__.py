"""Simulated surveys with exact truth.

Nothing here is shared with the builder of `scene`, and neither imports the other: otherwise truth and estimate would
agree by construction.
"""
