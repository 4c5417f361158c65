"""Tasks, agents and tunnels of a leaderboard, and its entries: one agent's episodes of one task, kept in a folder."""

import dataclasses
import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import subterra_jax as st
from benchmarks.command import BenchmarkError, require_least
from benchmarks.results import constants_facts, version, write_file
from subterra_jax import policies
from subterra_jax.baselines import registry
from subterra_jax.evaluation import Records, evaluate, listed_episodes
from subterra_jax.evaluation.bounds import stop_bounds
from subterra_jax.evaluation.episodes import N_LISTED, SHA256
from subterra_jax.host.files import require_folder
from subterra_jax.host.loading import file_digest, load_file, load_object, source_digest
from subterra_jax.policies.files import is_policy, read_facts
from subterra_jax.policies.opening import FORMS, TRAITS, names_code, policy_source
from subterra_jax.tasks import find
from subterra_jax.tunnel.plan import TunnelPlan

SCHEMA = "subterra.leaderboard-entry/1"
OWN_POLICY = "released-policy"  # the policy released for the task at hand
_digests: dict[str, str] = {}  # SHA-256 of the user's file that registered a task or an agent


@dataclass(frozen=True)
class LeaderboardConfig:
    """Settings of a leaderboard.

    Attributes:
        tasks: Task ids, as `Subterra/StopAt-v1`, `StopAt` or `FILE.py:ID`; all tasks if not given.
        agents: Agents: a baseline; `policy:NAME`, `policy:FILE` or `policy:RUN-FOLDER`; `released-policy`, the one
            released for the task; `module:Class` or `FILE.py:Class`. All baselines and `released-policy` if not given.
        load: Python files to run first; they register tasks or agents of your own.
        tunnels: Tunnel files, or names of packaged tunnels.
        linings: Variants of the walls; a tunnel with only one variant, as `control`, is driven with that.
        episodes: Number of episodes of each task, from the start of its list of 500; faults are spread evenly.
        batch: Episodes driven at the same time; affects memory and speed only.
        out: Folder for `leaderboard.md`, `.json`, `.png` and the entries; entries in it are not driven again.
        redraw: A `leaderboard.md`; its first tunnel is drawn again as a `.png` beside it, and nothing is driven.
    """

    tasks: tuple[str, ...] = ()
    agents: tuple[str, ...] = ()
    load: tuple[Path, ...] = ()
    tunnels: tuple[str, ...] = ("subterra-351",)
    linings: tuple[str, ...] = ("pockets",)
    episodes: int = N_LISTED
    batch: int = N_LISTED
    out: Path = Path("out/leaderboard")
    redraw: Path | None = None


@dataclass(frozen=True)
class World:
    """A tunnel with one lining.

    Attributes:
        name: Name or file of the tunnel, as given.
        lining: Variant of the walls.
        plan: The tunnel.
    """

    name: str
    lining: str
    plan: TunnelPlan

    @property
    def title(self) -> str:
        """Title for headings and file names."""
        return f"{self.plan.name}, {self.lining}"


def check(config: LeaderboardConfig) -> LeaderboardConfig:
    """Runs the user's files and returns the config with full names.

    Raises:
        BenchmarkError: A task or an agent is unknown, or a number is out of range.
        UserCodeError: A user's file or class cannot be loaded.
        OutputError: The folder cannot be written.
    """
    require_least(config, episodes=1, batch=1)
    if config.episodes > N_LISTED:
        raise BenchmarkError(f"episodes must be at most {N_LISTED}, got {config.episodes}")
    for name in ("tunnels", "linings"):
        if not getattr(config, name):
            raise BenchmarkError(f"{name} must name at least one")
    require_folder(config.out)
    policies.register_released()
    load_files(config.load)
    tasks = tuple(_full_task(name) for name in config.tasks) or tuple(st.TASKS)
    for name in config.agents:
        _require_agent(name)
    return dataclasses.replace(config, tasks=_unique(tasks), agents=_unique(config.agents))


def load_files(paths: tuple[Path, ...]) -> None:
    """Runs a user's files, which register tasks and agents, and remembers the digest of each.

    Raises:
        UserCodeError: A file is missing, or raises an error.
    """
    for path in paths:
        tasks, agents = dict(st.TASKS), registry.names()
        load_file(path)
        added = [name for name, task in st.TASKS.items() if tasks.get(name) is not task]
        added += [name for name in registry.names() if name not in agents]
        _digests.update(dict.fromkeys(added, file_digest(path)))


def code_digests(task: str, agent: str) -> dict[str, str]:
    """Returns the SHA-256 of the user's files that define a task or an agent; empty for those of the package."""
    digests = {name: _digests[name] for name in (task, agent) if name in _digests}
    return {**digests, agent: source_digest(load_object(agent))} if names_code(agent) else digests


def agents_for(config: LeaderboardConfig, task: str) -> tuple[str, ...]:
    """Returns the names of the agents that drive a task; `config` is one that `check` has returned."""
    if config.agents:
        return config.agents
    baselines = tuple(name for name in registry.names() if not name.startswith(policies.PREFIX))
    return baselines + ((OWN_POLICY,) if policies.name_for(task) in policies.released() else ())


def load_worlds(config: LeaderboardConfig) -> list[World]:
    """Loads every tunnel with every lining.

    Raises:
        TunnelError: A tunnel cannot be read, or has several linings but not this one.
    """
    worlds = []
    for name in config.tunnels:
        plan = st.load_tunnel(name)
        linings = tuple(plan.linings) if len(plan.linings) == 1 else config.linings
        for lining in linings:
            plan.lining(lining)
            worlds.append(World(name, lining, plan))
    return worlds


def _require_agent(name: str) -> None:
    """Refuses an unknown agent, and a class that cannot be loaded."""
    if name in (*registry.names(), OWN_POLICY) or is_policy(name.removeprefix(policies.PREFIX)):
        return
    if not names_code(name):
        raise BenchmarkError(f"no agent {name!r}; there are {', '.join(registry.names())}; or {FORMS}")
    load_object(name)


def _full_task(name: str) -> str:
    """Returns the id of a task; one given as `FILE.py:ID` is loaded first."""
    source, _, _ = name.rpartition(":")
    if source.endswith(".py"):
        load_files((Path(source),))
    full = find(name, short=True)
    if full not in st.TASKS:
        raise BenchmarkError(f"{full} is scored by benchmarks.b2_traverse; the leaderboard has {', '.join(st.TASKS)}")
    return full


def _unique(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names))


@dataclass(frozen=True)
class Entry:
    """Episodes of one agent.

    Attributes:
        task: Task id.
        world: Tunnel and lining, for reports.
        agent: Name of the agent.
        traits: Inputs that the agent declares: `uses_lidar`, `uses_map`, `privileged`.
        records: Its episodes.
        bounds: Success that theory allows without looking at the walls, see `stop_bounds`; `None` where unknown.
    """

    task: str
    world: str
    agent: str
    traits: dict[str, bool]
    records: Records
    bounds: dict[str, float] | None = None


def make_entry(folder: Path, task: str, world: World, agent: str, episodes: int, batch: int) -> tuple[Entry, bool]:
    """Evaluates an agent, or reads the entry of an earlier run with the same inputs.

    Args:
        folder: Folder of the entries.
        task: Task id.
        world: Tunnel and lining.
        agent: Name of the agent.
        episodes: Number of episodes.
        batch: Episodes driven at the same time.

    Returns:
        The entry, and whether it was read.

    Raises:
        OutputError: The folder cannot be written.
        PolicyError: A policy was made for another task.
        AgentError: The class makes no agent.
    """
    name = policies.PREFIX + policies.name_for(task) if agent == OWN_POLICY else agent
    inputs = {
        "schema": SCHEMA,
        "evaluation": SHA256,
        "task": task,
        "tunnel": _digest(world),
        "lining": world.lining,
        "agent": agent,
        "episodes": episodes,
        "version": version("subterra-jax"),
        **constants_facts(),
        **_weights(name),
        **({"code": code} if (code := code_digests(task, name)) else {}),
    }
    path = folder / f"{_file_name(task)}.{_file_name(world.title)}.{_file_name(agent)}.json"
    if (kept := _read(path, inputs)) is not None:
        records = Records.from_columns(kept["records"])
        return Entry(task, world.title, agent, kept["traits"], records, kept.get("bounds")), True
    env, params = st.make(task, world.plan, world.lining, estimates=True)
    driver = policies.open_agent(name, env, params)
    traits = {trait: bool(getattr(driver, trait)) for trait in TRAITS}
    records = evaluate(env, params, driver, listed_episodes(env, params, episodes), batch)
    plain = env.rule.errand == "stop" and not {"obstacles", "faults"} & set(params.parts)
    bounds = stop_bounds(params) if plain else None
    content = {"inputs": inputs, "traits": traits, "bounds": bounds, "records": records.as_columns()}
    write_file(path, (json.dumps(content, allow_nan=False) + "\n").encode())
    return Entry(task, world.title, agent, traits, records, bounds), False


def _read(path: Path, inputs: dict[str, Any]) -> dict[str, Any] | None:
    """Returns the content of an entry if it was made from the same inputs."""
    try:
        content = json.loads(path.read_bytes())
        return content if content["inputs"] == inputs else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _weights(agent: str) -> dict[str, str]:
    """Returns the digest of a policy's weights: other weights under the same name are driven again."""
    policy = policy_source(agent)
    return {} if policy is None else {"policy": read_facts(policy)["tensors_sha256"]}


def _digest(world: World) -> str:
    """Returns the hash of the geometry that is driven through."""
    digest = hashlib.sha256()
    for values in (world.plan.centre, world.plan.half_width, world.plan.lining(world.lining).segments):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _file_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9-]+", "_", name)
