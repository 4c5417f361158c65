"""The baselines by name; `register` adds further agents."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Agent, Known, Observed
from subterra_jax.baselines.ceiling import NAME as BAYES
from subterra_jax.baselines.ceiling import ceiling
from subterra_jax.baselines.histogram import NAME as HISTOGRAM
from subterra_jax.baselines.histogram import histogram_filter
from subterra_jax.baselines.navigator import Navigator
from subterra_jax.baselines.particle import particle_filter
from subterra_jax.baselines.scanmatch import scan_matching
from subterra_jax.baselines.stations import FusedCount, OdometerCount, Truth
from subterra_jax.baselines.steering import CentreLine, steering_of
from subterra_jax.compiled import in_32_bits
from subterra_jax.host.errors import SubterraError
from subterra_jax.state import EnvParams

Factory = Callable[[EnvParams], Agent]

_FACTORIES: dict[str, Factory] = {}


class AgentError(SubterraError):
    """There is no such agent, or its name is taken."""


@struct.dataclass
class Random(Agent):
    """Draws uniform commands, and gives no estimate."""

    name = "random"

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> Float[Array, ""]:
        return jnp.zeros(())

    def act(
        self, key: PRNGKeyArray, memory: Float[Array, ""], obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, Float[Array, ""]]:
        fraction = jax.random.uniform(key, (3,))
        speed = params.vehicle.speed_max * fraction[0]
        yaw_rate = params.vehicle.yaw_rate_max * (2.0 * fraction[1] - 1.0)
        no_estimate = jnp.full((), jnp.nan)
        return jnp.stack([speed, yaw_rate, no_estimate, jnp.zeros(()), 2.0 * fraction[2] - 1.0]), memory


def register(name: str, factory: Factory) -> None:
    """Adds an agent: a trained policy, a filter, a replayed trajectory.

    Args:
        name: Name on the board and the command line.
        factory: Makes the agent from a task's params, its map for instance.

    Raises:
        AgentError: The name is taken.
    """
    if name in _FACTORIES:
        raise AgentError(f"there is an agent {name!r} already")
    _FACTORIES[name] = factory


def names() -> tuple[str, ...]:
    """Returns the names of all agents, in order of registration."""
    return tuple(_FACTORIES)


@in_32_bits()
def make_agent(name: str, params: EnvParams) -> Agent:
    """Makes the agent of a name for a task.

    Raises:
        AgentError: There is no such agent.
    """
    if name not in _FACTORIES:
        raise AgentError(f"no agent {name!r}; there are {', '.join(_FACTORIES)}")
    return _FACTORIES[name](params)


def _navigator(name: str, localiser: Any) -> None:
    register(name, lambda params: Navigator(localiser, steering_of(params, CentreLine()), name=name))


register("random", lambda params: Random())
_navigator("dead-reckoning", OdometerCount())
_navigator("fused", FusedCount())
_navigator("oracle", Truth())
register("scan-matching", scan_matching)
register("particle-filter", particle_filter)
register(HISTOGRAM, histogram_filter)
register(BAYES, ceiling)
