"""Policies and worlds by name: what a command line points at, opened and checked before anything is compiled."""

import dataclasses
import hashlib
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np

import subterra_jax as st
from subterra_jax.plan import tunnel_file
from train import checkpoint, normalize
from train.errors import CheckpointError, ConfigError
from train.networks import Layout, Networks, Policy

_PACKAGES = ("subterra-jax", "jax", "jaxlib", "flax", "optax", "brax", "orbax-checkpoint", "numpy")


@dataclasses.dataclass(frozen=True)
class World:
    """A task on a tunnel.

    Attributes:
        task: Task id.
        env: The environment.
        params: Its parameters.
        facts: Task, lining, and the tunnel file's name, provenance and SHA-256: what identifies the world.
    """

    task: str
    env: Any
    params: Any
    facts: dict[str, Any]


def open_world(task: str, tunnel: Path | None, lining: str) -> World:
    """A task on a tunnel file, or on the packaged tunnel.

    Raises:
        ConfigError: There is no such task.
        TunnelError: The tunnel file is missing or wrong, or has no such lining.
    """
    if task not in st.TASKS:
        raise ConfigError(f"unknown task {task!r}; there are {', '.join(st.TASKS)}")
    plan = st.load_tunnel(tunnel)
    env, params = st.make(task, tunnel=plan, lining=lining)
    content = tunnel_file(tunnel).read_bytes()
    return World(
        task,
        env,
        params,
        {
            "task": task,
            "lining": lining,
            "tunnel": plan.name,
            "tunnel_provenance": plan.provenance,
            "tunnel_sha256": hashlib.sha256(content).hexdigest(),
        },
    )


def load_policy(folder: Path) -> tuple[Networks, Policy, dict[str, Any]]:
    """The policy of a run folder, or of one checkpoint in it.

    Returns:
        The networks it belongs to, the policy, and the facts saved with it.

    Raises:
        CheckpointError: It is missing, damaged, or does not fit the network that it names itself.
    """
    stored = checkpoint.load(folder)
    try:
        layout = Layout(**{name: _tuples(value) for name, value in stored.facts["layout"].items()})
    except (KeyError, TypeError, AttributeError) as error:
        raise CheckpointError(f"{stored.path}: field 'layout' of {checkpoint.FACTS} is missing or wrong") from error
    networks = Networks(layout)
    return networks, stored.restore("policy", policy_shapes(networks)), stored.facts


def policy_shapes(networks: Networks) -> Policy:
    """A policy of these networks with shapes in place of arrays."""
    return jax.eval_shape(
        lambda key: Policy(networks.init(key)["policy"], normalize.init((networks.layout.n_observation,))),
        jax.random.key(0),
    )


def check_fits(layout: Layout, world: World, source: Path) -> None:
    """Raises `CheckpointError` where a policy cannot drive in a world."""
    wanted = world.env.observation_size(world.params)
    if layout.n_observation != wanted:
        raise CheckpointError(
            f"{source}: made for observations of {layout.n_observation} numbers, {world.task} has {wanted}"
        )
    bounds = world.env.action_space(world.params)
    if not (np.allclose(layout.action_low, bounds.low) and np.allclose(layout.action_high, bounds.high)):
        raise CheckpointError(f"{source}: made for actions up to {layout.action_high}, {world.task} has {bounds.high}")


def versions() -> dict[str, str]:
    """Versions of the libraries that a result depends on."""
    found = {package.metadata["Name"]: package.version for package in metadata.distributions()}
    return {name: found.get(name, "not installed") for name in _PACKAGES}


def _tuples(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
