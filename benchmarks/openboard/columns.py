"""Columns of the leaderboard of version 1: the tunnels of each kind and split, and their episodes."""

import dataclasses
import zlib

import numpy as np

from benchmarks.command import BenchmarkError, require_least
from benchmarks.kinds import bare
from subterra_jax.baselines import registry
from subterra_jax.evaluation import Episodes
from subterra_jax.host.task_ids import PLANAR
from subterra_jax.policies.opening import policy_source
from subterra_jax.procedural.open_world import SPLITS, kinds_of
from subterra_jax.tasks import TaskError, find

SCHEMA = "subterra.openboard/1"
_FOUR = ("StopAt", "Return", "Obstructed", "Faulted")
TASKS = (*_FOUR, "Relocalise", *(f"{name}Offset" for name in _FOUR))
AGENTS = (
    "dead-reckoning",
    "fused",
    "ring-count",
    "ring-filter",
    "scan-matching",
    "particle-filter",
    "histogram-filter",
    "ceiling",
)
FIRST = {"val": 100}  # index of the first tunnel: the searches of settings had those before
N_LEVELS = 5


@dataclasses.dataclass(frozen=True)
class Column:
    """One kind of lining in one split.

    Attributes:
        kind: Kind of lining.
        split: Split of the open world.
    """

    kind: str
    split: str


def task_of(name: str) -> tuple[str, bool]:
    """Return a task's id, and whether its start is hidden: in the cells, `StopAtOffset` is `StopAt` with such a one."""
    return f"Subterra/{name.removesuffix('Offset')}-v1", name.endswith("Offset")


def columns_of(splits: tuple[str, ...]) -> tuple[Column, ...]:
    """Return the columns of some splits."""
    return tuple(Column(kind, split) for split in splits for kind in kinds_of(split))


def tunnel_names(columns: tuple[Column, ...], tunnels: int) -> list[str]:
    """Return the names of the tunnels of the columns, those of one column after another."""
    return [f"open:{c.kind}:{c.split}:{FIRST.get(c.split, 0) + i}" for c in columns for i in range(tunnels)]


def draw_episodes(task: str, columns: tuple[Column, ...], tunnels: int, n: int) -> Episodes:
    """Draw `n` episodes for each column; their seeds depend on task and split alone.

    The seeds lie below 2³⁰, where no listed episode is. Tunnels take turns, and severities as the tunnels have come
    round. The tunnel of an episode is its stratum.
    """
    index = np.arange(n)
    parts = []
    for place, column in enumerate(columns):
        generator = np.random.default_rng(zlib.crc32(f"{SCHEMA} {task} {column.split}".encode()))
        seed = generator.choice(2**29, n, replace=False).astype(np.uint32) + np.uint32(2**29)
        severity = index // tunnels % N_LEVELS if task.startswith("Faulted") else 0 * index
        parts.append((seed, place * tunnels + index % tunnels, severity, index % tunnels))
    seed, tunnel, severity, group = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    whole = (tunnel.astype(np.int32), severity.astype(np.int32), group.astype(np.int32))
    return Episodes(seed, *whole)


def check(
    tasks: tuple[str, ...], agents: tuple[str, ...], splits: tuple[str, ...], tunnels: int, episodes: int
) -> None:
    """Refuse what cannot be run, before anything is made.

    Raises:
        BenchmarkError: A task, agent or split is unknown, or a number is too small.
    """
    for task in tasks:
        try:
            find(task_of(task)[0])
        except TaskError as error:
            known = ", ".join(name.removeprefix("Subterra/")[:-3] for name in PLANAR)
            raise BenchmarkError(f"no task {task!r}; there are {known}") from error
    for agent in agents:
        if agent not in registry.names() and policy_source(bare(agent)) is None:
            raise BenchmarkError(f"no agent {agent!r}; there are {', '.join(registry.names())}")
    for split in splits:
        if split not in SPLITS:
            raise BenchmarkError(f"there is no split {split!r}; there are {', '.join(SPLITS)}")
    require_least(_Numbers(tunnels, episodes), tunnels=1, episodes=2)


@dataclasses.dataclass(frozen=True)
class _Numbers:
    tunnels: int
    episodes: int
