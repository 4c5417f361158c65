"""A trained policy, of either kind, as an agent of the evaluation and as tensors by name."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from subterra_jax.policies import from_tensors
from subterra_jax.policies.loading import Agent
from train.errors import ConfigError
from train.policies import AnyNetworks
from train.recurrent.network import RecurrentNetworks


def agent_of(networks: AnyNetworks, policy: Any, name: str | None = None) -> Agent:
    """An agent that drives without exploration noise.

    Args:
        networks: What the policy belongs to.
        policy: The policy.
        name: Name on the leaderboard; `ppo-mlp` or `ppo-gru` if left out.
    """
    layout = dataclasses.asdict(networks.layout)
    return from_tensors(networks.kind, layout, tensors_of(networks, policy), name or f"ppo-{networks.kind}")


def tensors_of(networks: AnyNetworks, policy: Any) -> dict[str, np.ndarray]:
    """What driving needs of a policy, by the names that `subterra_jax.policies` knows."""
    if networks.kind == "mlp":
        parts = {"policy": policy.weights, "statistics": {"mean": policy.statistics.mean, "std": policy.statistics.std}}
    else:
        parts = policy
    leaves = jax.tree_util.tree_flatten_with_path(jax.device_get(parts))[0]
    return {_name(path): np.asarray(leaf, np.float32) for path, leaf in leaves}


def weights_of(networks: RecurrentNetworks, tensors: Mapping[str, Any], source: str) -> dict[str, Any]:
    """The policy that `tensors_of` gave such tensors: what training goes on from.

    Args:
        networks: What it is to belong to.
        tensors: By name.
        source: Where they come from, for messages.

    Raises:
        ConfigError: They belong to another network.
    """
    leaves, tree = jax.tree_util.tree_flatten_with_path(networks.policy_shapes())
    for path, leaf in leaves:
        found = tensors.get(_name(path))
        if found is None or found.shape != leaf.shape:
            shape = "missing" if found is None else f"{found.shape}"
            raise ConfigError(f"begin_from = {source}: another network: {_name(path)} is {shape}, not {leaf.shape}")
    return jax.tree_util.tree_unflatten(tree, [np.asarray(tensors[_name(path)], np.float32) for path, _ in leaves])


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".").replace(".params.", ".")
