"""Trained policies: read from run folders, turned into agents, and written for release."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import jax
import numpy as np
from safetensors.numpy import save

from subterra_jax import policies as released
from subterra_jax.host.files import replace_file
from subterra_jax.policies import Conditions
from subterra_jax.policies.files import CHECKPOINT_POLICY, GAIT, SCHEMA, TENSORS
from subterra_jax.policies.files import FACTS as POLICY_FACTS
from subterra_jax.policies.trained import Trained
from train.belief.learner import BeliefLayout, BeliefNetworks
from train.checkpoint import FACTS, CheckpointError, load_checkpoint
from train.config import ConfigError
from train.feedforward.networks import Layout, Networks
from train.recurrent.network import RecurrentLayout, RecurrentNetworks
from train.world import require_task

AnyNetworks: TypeAlias = Any  # Networks | RecurrentNetworks | BeliefNetworks, or those of a gait
_KINDS: dict[str, Any] = {
    Networks.kind: (Layout, Networks),
    RecurrentNetworks.kind: (RecurrentLayout, RecurrentNetworks),
    BeliefNetworks.kind: (BeliefLayout, BeliefNetworks),
}


def load_policy(folder: Path) -> tuple[AnyNetworks, Any, dict[str, Any]]:
    """Reads the policy of a run folder, or of one checkpoint in it.

    Returns:
        Its networks, the policy, and the facts saved with it.

    Raises:
        CheckpointError: It is missing, damaged, or does not fit the network that it names itself.
    """
    stored = load_checkpoint(folder)
    layout_type, networks_type = _KINDS[stored.facts.get("kind", "mlp")]
    try:
        layout = layout_type(**{name: _tuples(value) for name, value in stored.facts["layout"].items()})
    except (KeyError, TypeError, AttributeError) as error:
        raise CheckpointError(f"{stored.path}: field 'layout' of {FACTS} is missing or wrong") from error
    networks = networks_type(layout)
    return networks, stored.restore("policy", networks.policy_shapes()), stored.facts


def open_agent(policy: Path | None, task: str | None) -> tuple[Trained, dict[str, Any]]:
    """Opens a policy by its file, folder or name, or the one released for a task.

    Returns:
        The agent and the facts saved with it: `task` and `world` at least.

    Raises:
        ConfigError: Neither is given.
        PolicyError: There is no such released policy, or it is damaged.
        CheckpointError: The folder holds no checkpoint, or a damaged one.
    """
    if policy is None:
        if task is None:
            raise ConfigError("a task or a policy must be named")
        task = require_task(task)
        policy = Path(released.name_for(task))
    if policy.suffix == TENSORS or (not policy.exists() and policy.name == str(policy)):
        return released.load(policy)
    networks, trained, facts = load_policy(policy)
    return make_agent(networks, trained, conditions=Conditions.from_facts(facts)), facts


def make_agent(
    networks: AnyNetworks, policy: Any, name: str | None = None, conditions: Conditions | None = None
) -> Trained:
    """Makes an agent that drives without exploration noise.

    Args:
        networks: Networks of the policy.
        policy: The policy.
        name: Name on the leaderboard; `ppo-mlp` or `ppo-gru` if left out.
        conditions: Conditions of its training; None: any.
    """
    layout = dataclasses.asdict(networks.layout)
    tensors = policy_tensors(networks, policy)
    return released.from_tensors(networks.kind, layout, tensors, name or f"ppo-{networks.kind}", conditions)


def policy_tensors(networks: AnyNetworks, policy: Any) -> dict[str, np.ndarray]:
    """Returns the arrays that driving needs of a policy, by the names that `subterra_jax.policies` knows."""
    if networks.kind == GAIT:
        parts = networks.tensors(policy)
    elif networks.kind == "mlp":
        parts = {"policy": policy.weights, "statistics": {"mean": policy.statistics.mean, "std": policy.statistics.std}}
    else:
        parts = policy
    leaves = jax.tree_util.tree_flatten_with_path(jax.device_get(parts))[0]
    return {_tensor_name(path): np.asarray(leaf, np.float32) for path, leaf in leaves}


def policy_weights(networks: RecurrentNetworks, tensors: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Returns the weights that have such tensors, from which training goes on; the inverse of `policy_tensors`.

    Args:
        networks: Networks that they must fit.
        tensors: By name.
        source: Origin of the tensors, for messages.

    Raises:
        ConfigError: They belong to another network.
    """
    leaves, tree = jax.tree_util.tree_flatten_with_path(networks.policy_shapes())
    for path, leaf in leaves:
        name = _tensor_name(path)
        tensor = tensors.get(name)
        if tensor is None or tensor.shape != leaf.shape:
            shape = "missing" if tensor is None else f"{tensor.shape}"
            raise ConfigError(f"begin_from = {source}: another network: {name} is {shape}, not {leaf.shape}")
    return jax.tree_util.tree_unflatten(
        tree, [np.asarray(tensors[_tensor_name(path)], np.float32) for path, _ in leaves]
    )


def write_policy(out: Path, networks: AnyNetworks, policy: Any, facts: dict[str, Any]) -> None:
    """Writes a policy's two files, the tensors' first.

    Args:
        out: The tensors' file.
        networks: Networks of the policy.
        policy: The policy.
        facts: At least `task` and `world`; name (in a checkpoint that of the kind), kind, layout and hash are added.

    Raises:
        OutputError: They cannot be written.
    """
    tensors = save(dict(sorted(policy_tensors(networks, policy).items())))
    whole = {
        "schema": SCHEMA,
        "name": f"ppo-{networks.kind}" if out.stem == CHECKPOINT_POLICY else out.stem,
        "kind": networks.kind,
        "tensors_sha256": hashlib.sha256(tensors).hexdigest(),
        "layout": dataclasses.asdict(networks.layout),
        **facts,
    }
    for path, content in ((out, tensors), (facts_file(out), f"{json.dumps(whole, indent=1)}\n".encode())):
        with replace_file(path) as fresh:
            fresh.write_bytes(content)


def facts_file(tensors: Path) -> Path:
    """Returns the path of the facts that belong to tensors."""
    return tensors.with_name(tensors.name.removesuffix(TENSORS) + POLICY_FACTS)


def _tensor_name(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".").replace(".params.", ".")


def _tuples(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
