"""Subterra: navigation without GNSS in tunnels, by the hundred thousand environments."""

import importlib.util

from subterra_jax import batch
from subterra_jax.batch import AutoReset, rollout
from subterra_jax.env import TraverseEnv
from subterra_jax.errors import SubterraError, TunnelError
from subterra_jax.plan import TunnelPlan, load_tunnel
from subterra_jax.state import EnvParams, State
from subterra_jax.tasks import TASKS, make
from subterra_jax.tunnel import Tunnel

__all__ = [
    "TASKS",
    "AutoReset",
    "EnvParams",
    "State",
    "SubterraError",
    "TraverseEnv",
    "Tunnel",
    "TunnelError",
    "TunnelPlan",
    "batch",
    "load_tunnel",
    "make",
    "rollout",
]

if importlib.util.find_spec("gymnasium") is not None:
    from subterra_jax.gym import register

    register()
