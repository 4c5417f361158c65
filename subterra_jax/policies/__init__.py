"""Trained policies that drive without the trainer.

files (safetensors + JSON) ─► load ─► networks or belief, an `Agent` of `subterra_jax.baselines`
"""

from subterra_jax.policies.files import PolicyError, name_for, released
from subterra_jax.policies.loading import PREFIX, check_fits, from_tensors, load, register_released, with_map

__all__ = [
    "PREFIX",
    "PolicyError",
    "check_fits",
    "from_tensors",
    "load",
    "name_for",
    "register_released",
    "released",
    "with_map",
]
