"""Ablations: a trained policy that goes without one of the things it is given, senses or keeps."""

import dataclasses
from typing import Any, Literal

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Known, Observed
from subterra_jax.policies import inputs
from subterra_jax.policies.inputs import Reckoned
from subterra_jax.policies.learnt import Learnt, LearntMemory
from subterra_jax.policies.memories import Located, Memory
from subterra_jax.state import EnvParams
from train.config import ConfigError

Part = Literal["start", "front", "walls", "odometry", "memory"]
_START_OFF = 40.0  # m


class Forgetful(Memory):
    """As `along`, but the way to go is dead-reckoned."""

    def _look(self, reckoned: Reckoned, located: Located | None, obs: Observed, params: EnvParams) -> Array:
        assert located is not None
        seen = inputs.look(reckoned, obs, inputs.way_to_go(reckoned, obs, params), params, self.relief)
        return self._with_place(seen, jnp.zeros(()), located.walls)


@struct.dataclass
class Lacking(Learnt):
    """A policy that lacks something that `act` and `begin` are given."""

    lacks: Part = struct.field(pytree_node=False, default="walls")  # what it lacks

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> LearntMemory:
        """Begins at the first observation, less what is lacking."""
        return super().begin(key, self._less(obs, params), params)

    def act(
        self, key: PRNGKeyArray, memory: LearntMemory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, LearntMemory]:
        """Returns the answer to an observation, less what is lacking."""
        if self.lacks == "memory":
            memory = dataclasses.replace(memory, cell=jnp.zeros_like(memory.cell))
        return super().act(key, memory, self._less(obs, params), params, known)

    def _less(self, obs: Observed, params: EnvParams) -> Observed:
        changed: dict[str, Any] = {}
        if self.lacks == "start":
            reported = params.start.station if obs.start is None else obs.start
            changed = {"start": jnp.asarray(reported) + _START_OFF}
        elif self.lacks == "walls":
            changed = {"ranges": jnp.full_like(obs.ranges, params.lidar.range_max)}
        elif self.lacks == "odometry":
            changed = {"distance": jnp.zeros_like(obs.distance), "heading": jnp.zeros_like(obs.heading)}
        return dataclasses.replace(obs, **changed)


def without(agent: Any, part: Part) -> Any:
    """Returns a policy without a part.

    Args:
        agent: The policy.
        part: `start` is reported 40 m off; `front`: what the walls tell its localiser; `walls`: every beam is without
            an echo, for localiser and steering; `odometry` stands still; `memory`: the way to go is dead-reckoned, and
            a GRU forgets.

    Raises:
        ConfigError: It has no such part.
    """
    kind = agent.layout.memory.kind if isinstance(agent, Learnt) else "none"
    if not isinstance(agent, Learnt) or (part == "front" and kind != "along"):
        raise ConfigError(f"{agent.name}: has no {part} to go without")
    if part == "memory" and kind not in ("along", "gru"):
        raise ConfigError(f"{agent.name}: its memory is {kind}; there is none to go without")
    if part == "front":
        return agent.without_walls()
    layout = agent.layout
    if part == "memory" and kind == "along":
        own = Forgetful(**dataclasses.asdict(layout.memory))
        layout = dataclasses.replace(layout, memory=own)
    fields = {field.name: getattr(agent, field.name) for field in dataclasses.fields(agent)}
    return Lacking(**{**fields, "layout": layout}, lacks=part)
