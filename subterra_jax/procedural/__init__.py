"""Tunnels drawn from a family: the same seed gives the same tunnel, and no seed is both trained and tested on."""

from subterra_jax.procedural.config import ProceduralConfig
from subterra_jax.procedural.control import control
from subterra_jax.procedural.family import SPLITS, expand, family, named, seed_of
from subterra_jax.procedural.generate import Draw, draw, plan

__all__ = ["SPLITS", "Draw", "ProceduralConfig", "control", "draw", "expand", "family", "named", "plan", "seed_of"]
