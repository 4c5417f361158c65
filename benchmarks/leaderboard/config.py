"""What to put on the leaderboard, and whether it can be had."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import subterra_jax as st
from subterra_jax import policies
from subterra_jax.baselines import registry
from subterra_jax.errors import SubterraError
from subterra_jax.evaluation.episodes import N_LISTED
from subterra_jax.outputs import require_folder
from subterra_jax.tunnel.plan import TunnelPlan
from subterra_jax.versions import no_task

OWN = "released-policy"  # the one that was released for the task at hand


class LeaderboardError(SubterraError):
    """A leaderboard that cannot be made as it was asked for."""


@dataclass(frozen=True)
class LeaderboardConfig:
    """What to put on the leaderboard.

    Attributes:
        tasks: Ids of tasks, as `Subterra/StopAt-v0` or `StopAt`; none given: all.
        agents: Names of agents: baselines, `policy:NAME` for a released policy, or `released-policy` for the one
            released for the task; none given: all baselines, and that one.
        tunnels: Tunnel files, or names of packaged tunnels.
        linings: Variants of the walls; a tunnel that has only one, as `control`, is driven with that.
        episodes: Episodes of each task, the first of its 500; with faults evenly over the severities.
        batch: Episodes driven at the same time; memory and speed alone depend on it.
        out: Folder for `leaderboard.md`, `.json`, `.png` and the entries. What is in it already is not driven again.
    """

    tasks: tuple[str, ...] = ()
    agents: tuple[str, ...] = ()
    tunnels: tuple[str, ...] = ("subterra-351",)
    linings: tuple[str, ...] = ("pockets",)
    episodes: int = N_LISTED
    batch: int = N_LISTED
    out: Path = Path("out/leaderboard")


@dataclass(frozen=True)
class World:
    """A tunnel with one lining.

    Attributes:
        name: The tunnel as it was named.
        lining: Variant of the walls.
        plan: The tunnel.
    """

    name: str
    lining: str
    plan: TunnelPlan

    @property
    def title(self) -> str:
        """For headings and file names."""
        return f"{self.plan.name}, {self.lining}"


def checked(config: LeaderboardConfig) -> LeaderboardConfig:
    """The config with names in full.

    Raises:
        LeaderboardError: A task or an agent that there is not, or a number out of range.
        OutputError: The folder cannot be written.
    """
    for name, value in (("episodes", config.episodes), ("batch", config.batch)):
        if value < 1:
            raise LeaderboardError(f"{name} must be at least 1, got {value}")
    if config.episodes > N_LISTED:
        raise LeaderboardError(f"episodes must be at most {N_LISTED}, got {config.episodes}")
    for name in ("tunnels", "linings"):
        if not getattr(config, name):
            raise LeaderboardError(f"{name} must name at least one")
    require_folder(config.out)
    tasks = tuple(_task(name) for name in config.tasks) or tuple(st.TASKS)
    policies.register_released()
    if unknown := [name for name in config.agents if name not in (*registry.names(), OWN)]:
        raise LeaderboardError(f"no agent {unknown[0]!r}; there are {', '.join(registry.names())}")
    return dataclasses.replace(config, tasks=_once(tasks), agents=_once(config.agents))


def agents_for(config: LeaderboardConfig, task: str) -> tuple[str, ...]:
    """Names of the agents that are to drive a task; `config` is one that `checked` has returned."""
    if config.agents:
        return config.agents
    baselines = tuple(name for name in registry.names() if not name.startswith(policies.PREFIX))
    return baselines + ((OWN,) if policies.name_for(task) in policies.released() else ())


def worlds(config: LeaderboardConfig) -> list[World]:
    """Every tunnel with every lining.

    Raises:
        TunnelError: A tunnel cannot be read, or has several linings and not this one.
    """
    found = []
    for name in config.tunnels:
        plan = st.load_tunnel(name)
        only = tuple(plan.linings) if len(plan.linings) == 1 else config.linings
        for lining in only:
            plan.lining(lining)
            found.append(World(name, lining, plan))
    return found


def _task(name: str) -> str:
    full = name if name in st.TASKS else f"Subterra/{name}-v0"
    if full not in st.TASKS:
        raise LeaderboardError(no_task(name, st.TASKS))
    return full


def _once(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names))
