"""Trained policies that drive without the trainer.

files (safetensors + JSON) ─► load ─► `Learnt` or `Locating`, an `Agent` of `subterra_jax.baselines`
observation ─► inputs ─► memories (reckoning, stack, localiser) ─► network ─► action, in training and in driving
any agent ─► load_policy ─► a function of observation and memory
"""

from subterra_jax.policies.files import TRAINED_UNDER, Conditions, PolicyError, name_for, released
from subterra_jax.policies.function import DrivingPolicy, Policy, load_policy
from subterra_jax.policies.loading import (
    PREFIX,
    check_fits,
    check_task,
    from_tensors,
    load,
    training_conditions,
)
from subterra_jax.policies.opening import open_agent

__all__ = [
    "PREFIX",
    "TRAINED_UNDER",
    "Conditions",
    "DrivingPolicy",
    "Policy",
    "PolicyError",
    "check_fits",
    "check_task",
    "from_tensors",
    "load",
    "load_policy",
    "name_for",
    "open_agent",
    "released",
    "training_conditions",
]
