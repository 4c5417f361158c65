"""Policies and worlds by name: what a command line points at, opened and checked before anything is compiled."""

import dataclasses
import hashlib
from importlib import metadata
from pathlib import Path
from typing import Any, TypeAlias

import subterra_jax as st
from subterra_jax.host.versions import VERSION
from subterra_jax.procedural import expand
from subterra_jax.tasks import TaskError, find
from subterra_jax.tunnel.sources import tunnel_digest
from train.belief.network import BeliefLayout, BeliefNetworks
from train.errors import CheckpointError, ConfigError
from train.feedforward.networks import Layout, Networks
from train.recurrent.network import RecurrentLayout, RecurrentNetworks
from train.run import checkpoint

_PACKAGES = ("jax", "jaxlib", "flax", "optax", "brax", "orbax-checkpoint", "numpy")
AnyNetworks: TypeAlias = Networks | RecurrentNetworks | BeliefNetworks
_KINDS: dict[str, Any] = {
    Networks.kind: (Layout, Networks),
    RecurrentNetworks.kind: (RecurrentLayout, RecurrentNetworks),
    BeliefNetworks.kind: (BeliefLayout, BeliefNetworks),
}


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


def known_task(task: str) -> str:
    """Return the id of a task; `FILE.py:ID` first runs a user's file.

    Raises:
        ConfigError: There is no such task, or this command does not learn it.
    """
    try:
        task = find(task)
    except TaskError as error:
        raise ConfigError(str(error)) from error
    if task not in st.TASKS:
        raise ConfigError(f"{task} is not learnt by this command; there are {', '.join(st.TASKS)}")
    return task


def open_world(task: str, tunnel: Path | str | None, lining: str | None = None) -> World:
    """A task on a tunnel file or on one that goes by a name; the packaged tunnel, and the usual lining, where None.

    `procedural:train:0-255` stands for several tunnels, of which each episode draws one.

    Raises:
        ConfigError: There is no such task, or the tunnel has no room for it.
        TunnelError: The tunnel file is missing or wrong, or has no such lining.
    """
    task = known_task(task)
    names = [tunnel] if tunnel is None else expand(str(tunnel))
    plans = [st.load_tunnel(name) for name in names]
    lining = lining or plans[0].default_lining
    try:
        env, params = st.make(task, tunnel=plans if len(plans) > 1 else plans[0], lining=lining)
    except st.SubterraError:
        raise
    except ValueError as error:
        raise ConfigError(str(error)) from error
    digests = [tunnel_digest(name) for name in names]
    return World(
        task,
        env,
        params,
        {
            "task": task,
            "lining": lining,
            "tunnel": plans[0].name if len(plans) == 1 else str(tunnel),
            "tunnel_provenance": plans[0].provenance,
            "tunnel_sha256": digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest(),
        },
    )


def load_policy(folder: Path) -> tuple[AnyNetworks, Any, dict[str, Any]]:
    """The policy of a run folder, or of one checkpoint in it.

    Returns:
        The networks it belongs to, the policy, and the facts saved with it.

    Raises:
        CheckpointError: It is missing, damaged, or does not fit the network that it names itself.
    """
    stored = checkpoint.load(folder)
    layout_of, networks_of = _KINDS[stored.facts.get("kind", "mlp")]
    try:
        layout = layout_of(**{name: _tuples(value) for name, value in stored.facts["layout"].items()})
    except (KeyError, TypeError, AttributeError) as error:
        raise CheckpointError(f"{stored.path}: field 'layout' of {checkpoint.FACTS} is missing or wrong") from error
    networks = networks_of(layout)
    return networks, stored.restore("policy", networks.policy_shapes()), stored.facts


def versions() -> dict[str, str]:
    """Versions of the libraries that a result depends on."""
    found = {package.metadata["Name"]: package.version for package in metadata.distributions()}
    return {"subterra-jax": VERSION, **{name: found.get(name, "not installed") for name in _PACKAGES}}


def _tuples(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
