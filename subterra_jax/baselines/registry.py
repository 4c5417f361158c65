"""The baselines by name; others add theirs with `register`."""

from collections.abc import Callable
from typing import Any

from subterra_jax.baselines.agent import Agent
from subterra_jax.baselines.avoidance import steering_of
from subterra_jax.baselines.fused import FusedCount
from subterra_jax.baselines.navigator import Navigator
from subterra_jax.baselines.particle import particle_agent
from subterra_jax.baselines.rings.grid import ring_filter
from subterra_jax.baselines.rings.loop import RingCount
from subterra_jax.baselines.scanmatch import scan_matching
from subterra_jax.baselines.simple import Random
from subterra_jax.baselines.stations import CommandCount, OdometerCount, Truth
from subterra_jax.baselines.steering import CentreLine, HeadingHold, Pursuit
from subterra_jax.host.errors import SubterraError
from subterra_jax.state import EnvParams

Factory = Callable[[EnvParams], Agent]

DEAD_RECKONING, CEILING = "dead-reckoning", "oracle"
_FACTORIES: dict[str, Factory] = {}


class AgentError(SubterraError):
    """There is no such agent, or its name is taken."""


def register(name: str, factory: Factory) -> None:
    """Add an agent: a trained policy, a filter, a replayed trajectory.

    Args:
        name: Its name on the leaderboard and the command line.
        factory: Makes it for a task, from the task's params (a map, say).

    Raises:
        AgentError: The name is taken.
    """
    if name in _FACTORIES:
        raise AgentError(f"there is an agent {name!r} already")
    _FACTORIES[name] = factory


def names() -> tuple[str, ...]:
    """Names of all agents, in order of registration."""
    return tuple(_FACTORIES)


def make_agent(name: str, params: EnvParams) -> Agent:
    """The agent of a name, for a task.

    Raises:
        AgentError: There is none.
    """
    if name not in _FACTORIES:
        raise AgentError(f"no agent {name!r}; there are {', '.join(_FACTORIES)}")
    return _FACTORIES[name](params)


def _navigator(name: str, localiser: Any, steering: Any) -> None:
    register(name, lambda params: Navigator(localiser, steering_of(params, steering), name=name))


register("random", lambda params: Random())
_navigator("blind-forward", CommandCount(), HeadingHold(gain=0.0))
_navigator("heading-hold", OdometerCount(), HeadingHold())
_navigator("command-integrator", CommandCount(), CentreLine())
_navigator("pure-pursuit", OdometerCount(), Pursuit())
_navigator(DEAD_RECKONING, OdometerCount(), CentreLine())
_navigator("fused", FusedCount(), CentreLine())
_navigator("ring-count", RingCount(), CentreLine())
register("ring-filter", ring_filter)
_navigator(CEILING, Truth(), CentreLine())
register("scan-matching", scan_matching)
register("particle-filter", particle_agent)
