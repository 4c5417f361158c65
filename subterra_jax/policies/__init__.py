"""Trained policies that drive without the trainer.

files (safetensors + JSON) ─► load ─► networks or belief, an `Agent` of `subterra_jax.baselines`
"""

from subterra_jax.policies.files import TRAINED_UNDER, Conditions, PolicyError, name_for, released
from subterra_jax.policies.loading import (
    PREFIX,
    check_fits,
    from_tensors,
    load,
    register_released,
    training_conditions,
    with_map,
)

__all__ = [
    "PREFIX",
    "TRAINED_UNDER",
    "Conditions",
    "PolicyError",
    "check_fits",
    "from_tensors",
    "load",
    "name_for",
    "register_released",
    "released",
    "training_conditions",
    "with_map",
]
