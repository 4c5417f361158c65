"""The agent of a trained network, and its layout: it takes in what training took in, and drives by the mean."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Known, Observed, observed
from subterra_jax.baselines.histogram import HistogramLocaliser
from subterra_jax.episode import in_tunnel
from subterra_jax.policies import inputs
from subterra_jax.policies.files import Conditions, PolicyError
from subterra_jax.policies.locate.map_strip import MapStrip
from subterra_jax.policies.memories import MEMORIES, Kept, Memory
from subterra_jax.policies.network import Network, Shape, init, start_memory, to_action
from subterra_jax.policies.trained import Tensors, Trained, nested, part
from subterra_jax.state import EnvParams
from subterra_jax.tunnel_env import TunnelEnv

KIND = "ppo"
NETWORK, LOCALISER = "network", "localiser"


@dataclasses.dataclass(frozen=True)
class Layout:
    """Everything about a policy that is no weight."""

    memory: Memory  # what is kept between observations
    shape: Shape  # sizes of the network
    action_low: tuple[float, ...]  # smallest action, m/s and rad/s
    action_high: tuple[float, ...]  # largest action, m/s and rad/s
    standing: float = 0.5  # fraction of the largest speed by which the range of the tanh goes below 0

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "Layout":
        """Reads a layout.

        Raises:
            KeyError: Something is missing.
            TypeError: Something is not known.
            ValueError: There is no such memory.
        """
        own = {field.name for field in dataclasses.fields(Memory)}
        memory = Memory(**{name: value for name, value in values["memory"].items() if name in own})
        shape = dict(values["shape"])
        if memory.kind not in MEMORIES:
            raise ValueError(f"memory must be one of {', '.join(MEMORIES)}, got {memory.kind!r}")
        shape["hidden"] = tuple(shape["hidden"])
        low, high = tuple(values["action_low"]), tuple(values["action_high"])
        return cls(memory, Shape(**shape), low, high, float(values["standing"]))

    def reckoned_way(self, seen: Float[Array, "n"]) -> Float[Array, ""]:
        """Returns the reckoned way to go among the inputs of one observation, m."""
        return inputs.FAR * seen[inputs.WAY_AT]


@struct.dataclass
class LearntMemory:
    """Memory of a trained network."""

    kept: Kept  # what it keeps between observations
    cell: Float[Array, "cell"]  # memory of its GRU
    command: Float[Array, "2"]  # last command as obeyed, m/s and rad/s


@struct.dataclass
class Learnt(Trained):
    """Drives by a trained network."""

    kind: ClassVar[str] = KIND
    prefix: ClassVar[str] = f"{LOCALISER}."
    uses_lidar = True
    tensors: Tensors  # weights by name, parts of the name between dots: `network.…`, and with a localiser `localiser.…`
    low: Float[Array, "n_action"]  # smallest action, m/s and rad/s
    high: Float[Array, "n_action"]  # largest action, m/s and rad/s
    layout: Layout = struct.field(pytree_node=False)  # memory and sizes of the network
    map: MapStrip | HistogramLocaliser | None = None
    hides_map: bool = struct.field(pytree_node=False, default=False)
    blind: bool = struct.field(pytree_node=False, default=False)
    name: str = struct.field(pytree_node=False, default=KIND)  # name on the board
    # conditions of its training; None: any
    conditions: Conditions | None = struct.field(pytree_node=False, default=None)

    @classmethod
    def of_layout(cls, layout: Mapping[str, Any], **common: Any) -> "Learnt":
        return cls(**common, layout=Layout.from_json(layout))

    def try_out(self) -> None:
        """Compares names and shapes of the tensors with the network's."""
        needed = jax.eval_shape(lambda key: {NETWORK: init(self.layout.shape, key)}, jax.random.key(0))
        if self.layout.memory.kind == "along":
            needed[LOCALISER] = self.localiser_shapes()
        self.check_tensors(needed)

    def check_task(self, env: TunnelEnv, params: EnvParams, source: str | Path) -> None:
        memory, here = self.layout.memory, in_tunnel(env, params, 0)
        given = (self.with_map(params) if self._filters else self).given

        def look(flat: Array) -> Array:
            return memory.inputs(memory.begin(observed(env, here, flat), here, given))

        size = jax.ShapeDtypeStruct((env.observation_size(params),), jnp.float32)
        found = jax.eval_shape(look, size).shape[0]
        if found != self.layout.shape.n_inputs:
            fields, known = ", ".join(env.fields(params)), self.conditions and self.conditions.fields
            of = f" of the fields {', '.join(known)}" if known else ""
            reads = f"{source}: reads {self.layout.shape.n_inputs} numbers{of}"
            raise PolicyError(f"{reads}; {env.id} with its fields {fields} has {found}")

    @property
    def uses_map(self) -> bool:
        """True where it has a map, or cannot do without."""
        return self._filters or super().uses_map

    def with_map(self, params: EnvParams) -> "Learnt":
        """As `Trained.with_map`; a filter on the map is made for every task that it can do."""
        if not self._filters:
            return super().with_map(params)
        return dataclasses.replace(self, map=HistogramLocaliser.of(params, cell=self.layout.memory.cell))

    @property
    def _filters(self) -> bool:
        return self.layout.memory.kind == "map"

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> LearntMemory:
        kept = self.layout.memory.begin(obs, params, self.given)
        return LearntMemory(kept, start_memory(self.layout.shape, ()), jnp.zeros(2))

    def act(
        self, key: PRNGKeyArray, memory: LearntMemory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, LearntMemory]:
        own = self.layout.memory
        kept = own.take(memory.kept, memory.command, obs, params, self.given)
        variables = {"params": nested(part(self.tensors, f"{NETWORK}."))}
        answers: Any = Network(self.layout.shape).apply(variables, own.inputs(kept), memory.cell)
        out, cell = answers
        action = to_action(out.mean, self.low, self.high, self.layout.standing)
        command = action[:2]
        if action.shape[0] < 5:
            action = jnp.concatenate([command, own.report(kept, command, obs, params)])
        return action, LearntMemory(kept, cell, command)
