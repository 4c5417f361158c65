"""The contract of a trained network as an agent: how a policy file becomes one, and which tasks it can do."""

import abc
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import jax
from jaxtyping import Array, Float

from subterra_jax.baselines.agent import Agent
from subterra_jax.policies.files import Conditions
from subterra_jax.state import EnvParams
from subterra_jax.tunnel_env import TunnelEnv

Tensors = dict[str, Float[Array, "..."]]


class Trained(Agent):
    """A trained agent. One class a kind of network, a `flax.struct.dataclass`; `loading.KINDS` lists them."""

    kind: ClassVar[str]  # name of the kind in a policy's facts
    learns_errand: ClassVar[bool] = True  # it has learnt one errand, and drives no task with another
    tensors: Any  # weights by name, as a policy's file holds them
    low: Any  # smallest action, m/s and rad/s
    high: Any  # largest action, m/s and rad/s
    conditions: Conditions | None  # conditions of its training; None: any

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
        """Lets it act on shapes alone, so that a missing or misshapen tensor is found before it drives.

        Raises:
            KeyError: A tensor is missing.
            TypeError: Tensors do not fit each other.
            ValueError: Tensors do not fit each other.
        """

    @abc.abstractmethod
    def check_task(self, env: TunnelEnv, params: EnvParams, source: str | Path) -> None:
        """Refuses a task whose errand or observation it does not know.

        Args:
            env: The environment.
            params: The task.
            source: Origin of the policy, with which the message begins.

        Raises:
            PolicyError: It cannot do this task.
        """

    def with_map(self, params: EnvParams) -> "Trained":
        """Returns the agent with the map of a task; itself if it uses none."""
        return self


def nested(tensors: Mapping[str, Any]) -> dict[str, Any]:
    """Returns weights by name as a tree: `match.taps` becomes `{"match": {"taps": …}}`."""
    tree: dict[str, Any] = {}
    for name, tensor in tensors.items():
        *path, last = name.split(".")
        branch = tree
        for part in path:
            branch = branch.setdefault(part, {})
        branch[last] = tensor
    return tree


def flat(weights: Any) -> dict[str, Any]:
    """Returns a tree of weights by name; the inverse of `nested`."""
    leaves = jax.tree_util.tree_flatten_with_path(weights)[0]
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
