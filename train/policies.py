"""Trained policies: opened by file, folder or name, turned into agents, and written to files."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

from subterra_jax import policies as released
from subterra_jax.host.files import replace_file
from subterra_jax.policies import Conditions
from subterra_jax.policies.files import CHECKPOINT_POLICY, SCHEMA, TENSORS
from subterra_jax.policies.files import FACTS as POLICY_FACTS
from subterra_jax.policies.learnt import KIND, LOCALISER, NETWORK, Learnt
from subterra_jax.policies.locate.agent import Locating
from subterra_jax.policies.trained import Trained, nested
from train.config import ConfigError
from train.driver import Driver, Policy
from train.world import require_task


def open_agent(policy: Path | None, task: str | None) -> tuple[Trained, dict[str, Any]]:
    """Opens a policy by its file, folder or name, or the one released for a task.

    Returns:
        The agent and the facts saved with it: `task` and `world` at least.

    Raises:
        ConfigError: Neither is given.
        PolicyError: There is no such policy, or it is damaged.
    """
    if policy is None:
        if task is None:
            raise ConfigError("a task or a policy must be named")
        policy = Path(released.name_for(require_task(task)))
    return released.load(policy)


def make_agent(driver: Driver, policy: Policy, name: str = KIND, conditions: Conditions | None = None) -> Trained:
    """Makes an agent that drives without exploration noise.

    Args:
        driver: What drove in training.
        policy: The policy.
        name: Name on the board.
        conditions: Conditions of its training; None: any.
    """
    return released.from_tensors(KIND, driver.layout.to_json(), driver.tensors(policy), name, conditions)


def begin_with(source: str) -> Policy:
    """Returns the weights of a policy to begin with: network and localiser, None where it has none.

    Args:
        source: A policy by name, file or run folder, or several with commas between, of which the later ones count.

    Raises:
        ConfigError: There is no such policy, or it has neither.
    """
    found = Policy(None)
    for name in source.split(","):
        try:
            agent, _ = released.load(name)
        except released.PolicyError as error:
            raise ConfigError(f"begin_from = {name}: {error}") from error
        if isinstance(agent, Locating):
            found = dataclasses.replace(found, localiser=nested(agent.tensors))
        elif isinstance(agent, Learnt):
            tree = nested(agent.tensors)
            localiser = tree.get(LOCALISER, found.localiser)
            found = dataclasses.replace(found, network=tree[NETWORK], localiser=localiser)
        else:
            raise ConfigError(f"begin_from = {name}: is no policy that drives")
    return found


def write_tensors(
    out: Path, kind: str, layout: Any, tensors: dict[str, np.ndarray], facts: dict[str, Any], half: bool = False
) -> None:
    """Writes a policy's two files, the tensors' first.

    Args:
        out: The tensors' file.
        kind: Kind of the policy.
        layout: Its layout.
        tensors: Its arrays by name.
        facts: At least `task` and `world`; name (in a checkpoint that of the kind), kind, layout and hash are added.
        half: Write float16.

    Raises:
        OutputError: They cannot be written.
    """
    number = np.float16 if half else np.float32
    content = save({name: tensor.astype(number) for name, tensor in sorted(tensors.items())})
    whole = {
        "schema": SCHEMA,
        "name": kind if out.stem == CHECKPOINT_POLICY else out.stem,
        "kind": kind,
        "tensors_sha256": hashlib.sha256(content).hexdigest(),
        "layout": layout.to_json(),
        **facts,
    }
    for path, data in ((out, content), (facts_file(out), f"{json.dumps(whole, indent=1)}\n".encode())):
        with replace_file(path) as fresh:
            fresh.write_bytes(data)


def facts_file(tensors: Path) -> Path:
    """Returns the path of the facts that belong to tensors."""
    return tensors.with_name(tensors.name.removesuffix(TENSORS) + POLICY_FACTS)
