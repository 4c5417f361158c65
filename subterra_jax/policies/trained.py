"""A trained network as an agent: how a policy file becomes one, which tasks it can do, and the map that it may take."""

import abc
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import jax
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Agent
from subterra_jax.policies.files import Conditions
from subterra_jax.policies.locate import memory
from subterra_jax.policies.locate.map_strip import map_strip
from subterra_jax.policies.memories import Given
from subterra_jax.state import EnvParams
from subterra_jax.tunnel_env import TunnelEnv

Tensors = dict[str, Float[Array, "..."]]


class Trained(Agent):
    """A trained agent, whose tensors may hold a learnt localiser.

    One class a kind of network, a `flax.struct.dataclass`; `loading.KINDS` lists them.
    """

    kind: ClassVar[str]  # name of the kind in a policy's facts
    prefix: ClassVar[str] = "localiser."  # beginning of the names of the localiser's tensors, if any
    learns_goal_kind: ClassVar[bool] = True  # it has learnt one goal kind, and drives no task with another
    tensors: Any  # weights by name, as a policy's file holds them
    low: Any  # smallest action, m/s and rad/s
    high: Any  # largest action, m/s and rad/s
    conditions: Conditions | None  # conditions of its training; None: any
    map: Any = None  # the map; None has none
    hides_map: bool = False  # take no map: `with_map` changes nothing
    blind: bool = False  # cut what the walls tell the localiser: an ablation

    @classmethod
    @abc.abstractmethod
    def of_layout(cls, layout: Mapping[str, Any], **common: Any) -> "Trained":
        """Makes the agent.

        Args:
            layout: The layout in the policy's facts.
            **common: `tensors`, `low`, `high`, `name` and `conditions`.

        Raises:
            KeyError: Something is missing in the layout.
            ValueError: A value in it is none that this release knows.
        """

    @abc.abstractmethod
    def try_out(self) -> None:
        """Compares names and shapes of the tensors with the network's, before it drives.

        Raises:
            KeyError: A tensor is missing.
            TypeError: Tensors do not fit each other.
            ValueError: Tensors do not fit each other.
        """

    @abc.abstractmethod
    def check_task(self, env: TunnelEnv, params: EnvParams, source: str | Path) -> None:
        """Refuses a task whose goal kind or observation it does not know; the message begins with `source`.

        Raises:
            PolicyError: It cannot do this task.
        """

    @property
    def uses_map(self) -> bool:
        return self.map is not None

    @property
    def takes_map(self) -> bool:
        return any(name.startswith(f"{self.prefix}{memory.MAP}.") for name in self.tensors)

    @property
    def given(self) -> Given:
        own = part(self.tensors, self.prefix)
        return Given(nested(own) if own else None, self.map, self.blind)

    def localiser_shapes(self) -> Any:
        front = memory.front_of(part(self.tensors, self.prefix))
        return jax.eval_shape(lambda key: memory.init(front, key, self.takes_map), jax.random.key(0))

    def check_tensors(self, needed: Any) -> None:
        """Compares names and shapes of the tensors with those needed; errors as `try_out`."""
        shapes = flat(needed)
        for name, leaf in shapes.items():
            if self.tensors[name].shape != leaf.shape:
                raise ValueError(f"{name} is {self.tensors[name].shape}, not {leaf.shape}")
        if further := sorted(set(self.tensors) - set(shapes)):
            raise ValueError(f"{further[0]} is of no such network")

    def with_map(self, params: EnvParams) -> Self:
        """Returns the agent with the map of a task if it takes one; runs on the host. A way back is driven without."""
        if not self.takes_map or self.hides_map or self.blind or params.goal_kind != "stop":
            return self
        return self._with(map=map_strip(params.tunnel))

    def without_map(self) -> Self:
        return self._with(map=None, hides_map=True, name=f"{self.name}, no map")

    def without_walls(self) -> Self:
        return self._with(map=None, blind=True, name=f"{self.name}, cut")

    def _with(self, **changes: Any) -> Self:
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]  # each subclass is a dataclass


def part(tensors: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Returns the tensors whose names begin with `prefix`, without it."""
    return {name.removeprefix(prefix): leaf for name, leaf in tensors.items() if name.startswith(prefix)}


def nested(tensors: Mapping[str, Any]) -> dict[str, Any]:
    """Returns weights by name as a tree: `match.taps` becomes `{"match": {"taps": …}}`."""
    tree: dict[str, Any] = {}
    for name, tensor in tensors.items():
        *path, last = name.split(".")
        branch = tree
        for step in path:
            branch = branch.setdefault(step, {})
        branch[last] = tensor
    return tree


def flat(weights: Any) -> dict[str, Any]:
    """Returns a tree of weights by name; the inverse of `nested`."""
    leaves = jax.tree_util.tree_flatten_with_path(weights)[0]
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
