"""Command lines of this room are read as those of the simulator are."""

from subterra_jax.arguments import parse

__all__ = ["parse"]
