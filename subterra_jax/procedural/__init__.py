"""Tunnels drawn from a family: the same seed gives the same tunnel, and no seed is both trained and tested on."""

from subterra_jax.procedural.family import SPLITS, Draw, control, draw, expand, family, generate, plan, seed_of
from subterra_jax.procedural.geometry import ProceduralConfig

__all__ = ["SPLITS", "Draw", "ProceduralConfig", "control", "draw", "expand", "family", "generate", "plan", "seed_of"]
