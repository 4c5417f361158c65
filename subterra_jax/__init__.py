"""Subterra: navigation without GNSS in tunnels, by the hundred thousand environments.

The names below are imported at first use, so that `import subterra_jax` and `subterra_jax.host` load no jax.
"""

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

from subterra_jax.host.errors import SubterraError, TunnelError
from subterra_jax.host.versions import VERSION

if TYPE_CHECKING:
    from subterra_jax import batch, parts, procedural, rules, tasks, tunnel
    from subterra_jax.batch import AutoReset, rollout
    from subterra_jax.compiled import cache_programs
    from subterra_jax.env import Env
    from subterra_jax.evaluation.localisability import localisability
    from subterra_jax.policies import load_policy
    from subterra_jax.randomization import LogUniform, randomize
    from subterra_jax.state import EnvParams, State
    from subterra_jax.tasks import TASKS, constants_digest, list_tasks, make, register
    from subterra_jax.tunnel import Tunnel
    from subterra_jax.tunnel.plan import TunnelPlan
    from subterra_jax.tunnel.sources import load_tunnel
    from subterra_jax.tunnel.tunnel import stack
    from subterra_jax.tunnel_env import TunnelEnv

__version__ = VERSION

# Name: module that holds it. The imports above say the same to type checkers.
_HOMES = {
    "TASKS": "tasks",
    "AutoReset": "batch",
    "Env": "env",
    "cache_programs": "compiled",
    "constants_digest": "tasks",
    "list_tasks": "tasks",
    "register": "tasks",
    "EnvParams": "state",
    "LogUniform": "randomization",
    "State": "state",
    "Tunnel": "tunnel",
    "TunnelEnv": "tunnel_env",
    "TunnelPlan": "tunnel.plan",
    "load_policy": "policies",
    "localisability": "evaluation.localisability",
    "load_tunnel": "tunnel.sources",
    "make": "tasks",
    "randomize": "randomization",
    "rollout": "batch",
    "stack": "tunnel.tunnel",
}
_MODULES = ("batch", "parts", "procedural", "rules", "tasks", "tunnel")
__all__ = ["SubterraError", "TunnelError", *_HOMES, *_MODULES]


def __getattr__(name: str) -> Any:
    """Imports a public name at its first use."""
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Lists the public names, imported or not."""
    return sorted({*globals(), *__all__})


if importlib.util.find_spec("gymnasium") is not None:
    from subterra_jax.adapters import register_tasks

    register_tasks()
