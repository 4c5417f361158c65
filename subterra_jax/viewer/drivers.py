"""Who can drive: the baselines, the released policies, and those of the command line."""

from collections.abc import Iterator
from pathlib import Path

import subterra_jax as st
from subterra_jax import policies
from subterra_jax.baselines import registry
from subterra_jax.policies.loading import Agent
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.viewer.driving import drive
from subterra_jax.viewer.recording import Recording


def offer(files: tuple[Path, ...]) -> tuple[str, ...]:
    """Names of all who can drive.

    Args:
        files: Trained policies, offered as `file:STEM`.

    Raises:
        PolicyError: One of them is missing or damaged.
    """
    policies.register_released()
    for path in files:
        agent, _ = policies.load(path)
        name = f"file:{path.stem}"
        if name not in registry.names():
            registry.register(name, lambda params, agent=agent: policies.told(agent, params))  # type: ignore[misc]
    return registry.names()


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
    env, params = st.make(task, tunnel=plan, lining=lining)
    driver = registry.make_agent(agent, params)
    if isinstance(driver, Agent):
        policies.check_fits(driver, env, params, agent)
    names = {"tunnel": title, "tunnel_sha256": digest, "lining": lining, "agent": agent}
    yield from drive(env, params, driver, seed, names)
