"""Settings of a leaderboard: tasks, agents and tunnels, and a user's own files that add to them."""

import dataclasses
import hashlib
import importlib
import importlib.util
import inspect
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import subterra_jax as st
from subterra_jax import policies
from subterra_jax.baselines import registry
from subterra_jax.evaluation.episodes import N_LISTED
from subterra_jax.host.errors import SubterraError
from subterra_jax.host.files import require_folder
from subterra_jax.host.versions import no_task
from subterra_jax.policies.files import TENSORS
from subterra_jax.tunnel.plan import TunnelPlan

OWN_POLICY = "released-policy"  # the policy released for the task at hand
TRAITS = ("uses_lidar", "uses_map", "privileged")
_added_by: dict[str, dict[str, str]] = {}  # of each loaded file, the tasks and agents that it registered


class LeaderboardError(SubterraError):
    """A leaderboard cannot be made with these settings."""


@dataclass(frozen=True)
class LeaderboardConfig:
    """Settings of a leaderboard.

    Attributes:
        tasks: Task ids, as `Subterra/StopAt-v0` or `StopAt`; all tasks if not given.
        agents: Agents: a baseline; `policy:NAME` or `policy:FILE`; `released-policy`, the one released for the task;
            `module:Class` or `FILE.py:Class`. All baselines and `released-policy` if not given.
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
        LeaderboardError: A task or an agent is unknown, a number is out of range, or a user's file fails.
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
    policies.register_released()
    for path in config.load:
        load_file(path)
    tasks = tuple(_full_task(name) for name in config.tasks) or tuple(st.TASKS)
    for name in config.agents:
        _require_agent(name)
    return dataclasses.replace(config, tasks=_unique(tasks), agents=_unique(config.agents))


def load_file(path: Path) -> ModuleType:
    """Runs a user's Python file, once in a process, so that it can register tasks and agents.

    Raises:
        LeaderboardError: The file is missing, or raises an error.
    """
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise LeaderboardError(f"{path}: cannot be read ({error.strerror})") from error
    name = f"{path.stem}_{digest[:12]}"
    if name in sys.modules:
        return sys.modules[name]
    known = {*st.TASKS, *registry.names()}
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise LeaderboardError(f"{path}: is no Python file")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise LeaderboardError(f"{path}: {type(error).__name__}: {error}") from error
    _added_by[name] = {added: digest for added in (*st.TASKS, *registry.names()) if added not in known}
    return module


def code_digests(task: str, agent: str) -> dict[str, str]:
    """Return the SHA-256 of the user's files that define a task or an agent; empty for those of the package."""
    digests = {name: digest for added in _added_by.values() for name, digest in added.items()}
    found = {name: digests[name] for name in (task, agent) if name in digests}
    if _is_class(agent):
        source = inspect.getsourcefile(_load_class(agent))
        found[agent] = hashlib.sha256(Path(source).read_bytes()).hexdigest() if source else "unknown"
    return found


def make_driver(name: str, params: st.EnvParams) -> Any:
    """Makes an agent for a task.

    Args:
        name: A baseline, `policy:NAME`, `policy:FILE`, `module:Class` or `FILE.py:Class`. A class, or a function that
            makes an agent, is called with the task's params where it has a parameter without a default.
        params: Params of the task.

    Raises:
        LeaderboardError: The class cannot be loaded, or what it makes is no agent.
    """
    if name in registry.names():
        return registry.make_agent(name, params)
    if name.startswith(policies.PREFIX):
        agent = policies.told(policies.load(name.removeprefix(policies.PREFIX))[0], params)
    else:
        factory = _load_class(name)
        parameters = inspect.signature(factory).parameters.values()
        needs_params = any(one.default is one.empty for one in parameters if one.kind is one.POSITIONAL_OR_KEYWORD)
        agent = factory(params) if needs_params else factory()
    if missing := [one for one in (*TRAITS, "begin", "act") if not hasattr(agent, one)]:
        raise LeaderboardError(f"agent {name!r} has no {', '.join(missing)}")
    return agent


def agents_for(config: LeaderboardConfig, task: str) -> tuple[str, ...]:
    """Return the names of the agents that drive a task; `config` is one that `check` has returned."""
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
    if name in (*registry.names(), OWN_POLICY) or (name.startswith(policies.PREFIX) and name.endswith(TENSORS)):
        return
    if not _is_class(name):
        known = ", ".join(registry.names())
        raise LeaderboardError(f"no agent {name!r}; there are {known}; or policy:FILE, module:Class, FILE.py:Class")
    _load_class(name)


def _is_class(agent: str) -> bool:
    """Returns whether an agent is given as `module:Class` or `FILE.py:Class`."""
    return ":" in agent and agent not in registry.names() and not agent.startswith(policies.PREFIX)


def _load_class(name: str) -> Any:
    """Loads `module:Class` or `FILE.py:Class`."""
    place, _, attribute = name.rpartition(":")
    if place.endswith(".py"):
        module = load_file(Path(place))
    else:
        try:
            module = importlib.import_module(place)
        except ImportError as error:
            raise LeaderboardError(f"agent {name!r}: {error}") from error
    try:
        return getattr(module, attribute)
    except AttributeError as error:
        raise LeaderboardError(f"agent {name!r}: {place} has no {attribute!r}") from error


def _full_task(name: str) -> str:
    full = name if name in st.TASKS else f"Subterra/{name}-v0"
    if full not in st.TASKS:
        raise LeaderboardError(no_task(name, st.TASKS))
    return full


def _unique(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names))
