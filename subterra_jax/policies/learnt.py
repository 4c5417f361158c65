"""The agent of a trained network: it takes in what training took in, and drives by the mean of the distribution."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Known, Observed, observed
from subterra_jax.episode import in_tunnel
from subterra_jax.policies.files import Conditions, PolicyError
from subterra_jax.policies.layout import Layout
from subterra_jax.policies.locate import memory as localisers
from subterra_jax.policies.locate.map_strip import MapStrip, map_strip
from subterra_jax.policies.memories import Given, Kept
from subterra_jax.policies.network import Network, init, start_memory, to_action
from subterra_jax.policies.trained import Tensors, Trained, flat, nested
from subterra_jax.state import EnvParams
from subterra_jax.tunnel_env import TunnelEnv

KIND = "ppo"
NETWORK, LOCALISER = "network", "localiser"


@struct.dataclass
class LearntMemory:
    """Memory of a trained network.

    Attributes:
        kept: What it keeps between observations.
        cell: Memory of its GRU.
        command: Last command as obeyed, m/s and rad/s.
    """

    kept: Kept
    cell: Float[Array, "cell"]
    command: Float[Array, "2"]


@struct.dataclass
class Learnt(Trained):
    """Drives by a trained network.

    Attributes:
        tensors: Weights by name, parts of the name between dots: `network.…`, and with a localiser `localiser.…`.
        low: Smallest action, m/s and rad/s.
        high: Largest action, m/s and rad/s.
        layout: Memory and sizes of the network.
        map: The map, where its localiser has learnt to take one; None has none.
        hides_map: Take no map: `with_map` changes nothing.
        blind: Cut what the walls tell its localiser: an ablation.
        name: Name on the leaderboard.
        conditions: Conditions of its training; None: any.
    """

    kind: ClassVar[str] = KIND
    uses_lidar = True
    tensors: Tensors
    low: Float[Array, "n_action"]
    high: Float[Array, "n_action"]
    layout: Layout = struct.field(pytree_node=False)
    map: MapStrip | None = None
    hides_map: bool = struct.field(pytree_node=False, default=False)
    blind: bool = struct.field(pytree_node=False, default=False)
    name: str = struct.field(pytree_node=False, default=KIND)
    conditions: Conditions | None = struct.field(pytree_node=False, default=None)

    @classmethod
    def of_layout(cls, layout: Mapping[str, Any], **common: Any) -> "Learnt":
        """Makes the agent of `Layout.to_json`."""
        return cls(**common, layout=Layout.from_json(layout))

    def try_out(self) -> None:
        """Compares names and shapes of the tensors with the network's."""
        wanted = jax.eval_shape(lambda key: {NETWORK: init(self.layout.shape, key)}, jax.random.key(0))
        if self.layout.memory.kind == "along":
            own = {name.removeprefix(f"{LOCALISER}."): leaf for name, leaf in self.tensors.items()}
            front = localisers.front_of(own)
            kind = self.layout.memory.localiser
            wanted[LOCALISER] = jax.eval_shape(
                lambda key: localisers.init(kind, front, key, self.takes_map), jax.random.key(0)
            )
        for name, leaf in flat(wanted).items():
            if self.tensors[name].shape != leaf.shape:
                raise ValueError(f"{name} is {self.tensors[name].shape}, not {leaf.shape}")
        if further := sorted(set(self.tensors) - set(flat(wanted))):
            raise ValueError(f"{further[0]} is of no such network")

    def check_task(self, env: TunnelEnv, params: EnvParams, source: str | Path) -> None:
        """Refuses an observation of another size, and an action of another."""
        memory, here = self.layout.memory, in_tunnel(env, params, 0)

        def look(flat: Array) -> Array:
            return memory.inputs(memory.begin(observed(env, here, flat), here, self._given))

        size = jax.ShapeDtypeStruct((env.observation_size(params),), jnp.float32)
        found = jax.eval_shape(look, size).shape[0]
        if found != self.layout.shape.n_inputs:
            fields = ", ".join(env.fields(params))
            raise PolicyError(
                f"{source}: reads {self.layout.shape.n_inputs} numbers; {env.id} with its fields {fields} has {found}"
            )

    @property
    def uses_map(self) -> bool:
        """True once it has a map."""
        return self.map is not None

    @property
    def takes_map(self) -> bool:
        """True where its localiser has learnt to take a map."""
        return any(name.startswith(f"{LOCALISER}.{localisers.MAP}.") for name in self.tensors)

    def with_map(self, params: EnvParams) -> "Learnt":
        """Returns the agent with the map of a task if it takes one; runs on the host. A way back is driven without."""
        if not self.takes_map or self.hides_map or self.blind or params.errand != "stop":
            return self
        return dataclasses.replace(self, map=map_strip(params.tunnel))

    def without_map(self) -> "Learnt":
        """Returns the agent with the same weights, and no map."""
        return dataclasses.replace(self, map=None, hides_map=True, name=f"{self.name}, no map")

    def without_walls(self) -> "Learnt":
        """Returns the agent with its localiser cut out: the same weights, and nothing that the walls tell it."""
        return dataclasses.replace(self, map=None, blind=True, name=f"{self.name}, cut")

    @property
    def _given(self) -> Given:
        prefix = f"{LOCALISER}."
        own = {name.removeprefix(prefix): leaf for name, leaf in self.tensors.items() if name.startswith(prefix)}
        return Given(nested(own) if own else None, self.map, self.blind)

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> LearntMemory:
        """Begins at the first observation, which `act` takes in."""
        del key
        kept = self.layout.memory.begin(obs, params, self._given)
        return LearntMemory(kept, start_memory(self.layout.shape, ()), jnp.zeros(2))

    def act(
        self, key: PRNGKeyArray, memory: LearntMemory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, LearntMemory]:
        """Returns command and estimate of one control period, and the memory after it."""
        del key, known
        own = self.layout.memory
        kept = own.take(memory.kept, memory.command, obs, params, self._given)
        prefix = f"{NETWORK}."
        weights = {name.removeprefix(prefix): leaf for name, leaf in self.tensors.items() if name.startswith(prefix)}
        variables = {"params": nested(weights)}
        answers: Any = Network(self.layout.shape).apply(variables, own.inputs(kept), memory.cell)
        out, cell = answers
        action = to_action(out.mean, self.low, self.high, self.layout.standing)
        command = action[:2]
        if action.shape[0] < 5:
            station, log_sigma, direction = own.estimate(kept, obs, params)
            station = station + direction * command[0] * params.vehicle.period
            action = jnp.concatenate([command, jnp.stack([station, log_sigma, direction])])
        return action, LearntMemory(kept, cell, command)
