"""Subterra: navigation without GNSS in tunnels, by the hundred thousand environments."""

import importlib.util

from subterra_jax import batch, procedural, tunnel
from subterra_jax.batch import AutoReset, rollout
from subterra_jax.env import TunnelEnv
from subterra_jax.errors import SubterraError, TunnelError
from subterra_jax.randomize import LogUniform, randomize
from subterra_jax.state import EnvParams, State
from subterra_jax.tasks import TASKS, make
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.tunnel.sources import load_tunnel
from subterra_jax.tunnel.tunnel import stack
from subterra_jax.versions import VERSION

__version__ = VERSION

__all__ = [
    "TASKS",
    "AutoReset",
    "EnvParams",
    "LogUniform",
    "State",
    "SubterraError",
    "Tunnel",
    "TunnelEnv",
    "TunnelError",
    "TunnelPlan",
    "batch",
    "load_tunnel",
    "make",
    "procedural",
    "randomize",
    "rollout",
    "stack",
    "tunnel",
]

if importlib.util.find_spec("gymnasium") is not None:
    from subterra_jax.adapters.registration import register

    register()
