"""Who can drive: the baselines, the released policies, and those of the command line."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import subterra_jax as st
from subterra_jax import policies, tasks
from subterra_jax.b2 import MISSIONS
from subterra_jax.baselines import registry
from subterra_jax.policies.loading import Agent
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.viewer.driving import drive
from subterra_jax.viewer.recording import Recording

TASKS = (*tasks.TASKS, *MISSIONS)  # that can be watched


def offer(files: tuple[Path, ...]) -> tuple[str, ...]:
    """Names of all who can drive.

    Args:
        files: Trained policies, offered as `file:STEM`.

    Raises:
        PolicyError: One of them is missing or damaged.
    """
    policies.register_released()
    for name in sorted(policies.released().keys() & {policies.name_for(task) for task in MISSIONS}):
        _register(policies.PREFIX + name, policies.load(name)[0])
    for path in files:
        agent, _ = policies.load(path)
        _register(f"file:{path.stem}", agent)
    return registry.names()


def _register(name: str, agent: Any) -> None:
    if name not in registry.names():
        registry.register(name, lambda params: policies.told(agent, params))


def episode(
    plan: TunnelPlan, digest: str, title: str, lining: str, task: str, agent: str, seed: int
) -> Iterator[Recording]:
    """An episode as it is driven, longer and longer.

    Args:
        plan: The tunnel.
        digest: Its SHA-256.
        title: What it is called.
        lining: Variant of its walls.
        task: Id of the task.
        agent: Name of who drives.
        seed: Seed of the episode.

    Raises:
        SubterraError: There is no such agent, or it does not fit the task.
        ValueError: There is no such task, or no room for it in the tunnel.
    """
    legs: dict[str, Any] = {"engine": "mujoco"} if task in MISSIONS else {}
    env, params = st.make(task, tunnel=plan, lining=lining, **legs)
    driver = registry.make_agent(agent, params)
    if isinstance(driver, Agent):
        policies.check_fits(driver, env, params, agent)
    names = {"tunnel": title, "tunnel_sha256": digest, "lining": lining, "agent": agent}
    yield from drive(env, params, driver, seed, names)
