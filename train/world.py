"""Worlds to train on: a task on a tunnel, opened and checked before anything is compiled."""

import dataclasses
import hashlib
from importlib import metadata
from pathlib import Path
from typing import Any

import subterra_jax as st
from subterra_jax.host.versions import VERSION
from subterra_jax.procedural import expand
from subterra_jax.tasks import TaskError, find
from subterra_jax.tunnel.sources import tunnel_digest
from train.config import ConfigError

_PACKAGES = ("jax", "jaxlib", "flax", "optax", "brax", "orbax-checkpoint", "numpy")


@dataclasses.dataclass(frozen=True)
class World:
    """A task on a tunnel.

    Attributes:
        task: Task id.
        env: The environment.
        params: Its parameters.
        facts: Task, lining, and the tunnel file's name, provenance and SHA-256: the identity of the world.
    """

    task: str
    env: Any
    params: Any
    facts: dict[str, Any]


def require_task(task: str) -> str:
    """Returns the id of a task; `FILE.py:ID` first runs a user's file.

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
    """Opens a task on a tunnel.

    Args:
        task: Task id.
        tunnel: File or name; None is the packaged tunnel. `procedural:train:0-255` means several tunnels, of which each
            episode draws one.
        lining: Variant of the walls; None is the tunnel's usual one.

    Raises:
        ConfigError: There is no such task, or the tunnel has no room for it.
        TunnelError: The tunnel file is missing or wrong, or has no such lining.
    """
    task = require_task(task)
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
    facts = {
        "task": task,
        "lining": lining,
        "tunnel": plans[0].name if len(plans) == 1 else str(tunnel),
        "tunnel_provenance": plans[0].provenance,
        "constants": st.constants_digest(env, params),
        "tunnel_sha256": digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest(),
    }
    return World(task, env, params, facts)


def library_versions() -> dict[str, str]:
    """Returns the versions of the libraries that a result depends on."""
    installed = {package.metadata["Name"]: package.version for package in metadata.distributions()}
    return {"subterra-jax": VERSION, **{name: installed.get(name, "not installed") for name in _PACKAGES}}
