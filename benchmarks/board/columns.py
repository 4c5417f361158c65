"""Columns of the board: the tunnels of each kind and split, further tunnels, and the episodes in them."""

import dataclasses
import zlib
from collections.abc import Sequence

import numpy as np

from benchmarks.command import BenchmarkError
from subterra_jax.evaluation import Episodes
from subterra_jax.procedural.open_world import SPLITS, kinds_of

FIRST = {"val": 100}  # index of the first tunnel: the searches of settings had those before
N_LEVELS = 5
OWN = "own"  # in place of a split, for further tunnels
_SEED = "subterra.openboard/1"  # of the episodes; the schema of the first cells


@dataclasses.dataclass(frozen=True)
class Column:
    """One kind of lining in one split, or one further tunnel."""

    kind: str  # Kind of lining, or the tunnel's name
    split: str  # Split of the open world, or `OWN`


@dataclasses.dataclass(frozen=True)
class Setting:
    """A task, whether its start is hidden, and how bright its walls are."""

    task: str  # A task of the benchmark without `Subterra/` and version, or the id of one's own
    hidden_start: bool = False  # Whether the start that is given is wrong by an unknown amount
    texture: float = 0.0  # Dial of the walls' texture; above 0 agents get intensities

    @property
    def words(self) -> str:
        """Name for tables."""
        hidden = ", hidden start" if self.hidden_start else ""
        return f"{self.task}{hidden}" + (f", texture {self.texture:g}" if self.texture else "")


def columns_of(splits: Sequence[str], further: Sequence[str] = ()) -> tuple[Column, ...]:
    """Return the columns of some splits, then one for each further tunnel.

    Raises:
        BenchmarkError: A split is unknown.
    """
    for split in splits:
        if split not in SPLITS:
            raise BenchmarkError(f"there is no split {split!r}; there are {', '.join(SPLITS)}")
    kinds = tuple(Column(kind, split) for split in splits for kind in kinds_of(split))
    return (*kinds, *(Column(name, OWN) for name in further))


def tunnels_in(split: str, tunnels: int) -> int:
    """Return the number of tunnels of a column: a further tunnel stands alone."""
    return 1 if split == OWN else tunnels


def tunnel_names(columns: Sequence[Column], tunnels: int) -> list[str]:
    """Return the names of the tunnels of the columns, those of one column after another."""
    return [name for column in columns for name in _names(column, tunnels)]


def _names(column: Column, tunnels: int) -> list[str]:
    if column.split == OWN:
        return [column.kind]
    first = FIRST.get(column.split, 0)
    return [f"open:{column.kind}:{column.split}:{first + i}" for i in range(tunnels)]


def draw_episodes(setting: Setting, columns: Sequence[Column], tunnels: int, n: int, faults: bool) -> Episodes:
    """Draw `n` episodes for each column; their seeds depend on setting and split alone.

    The seeds lie below 2³⁰, where no listed episode is. Tunnels take turns, and severities as the tunnels have come
    round. The tunnel of an episode is its stratum.

    Args:
        setting: What is driven.
        columns: The columns.
        tunnels: Tunnels of each column.
        n: Episodes of each column.
        faults: Whether the task has faults, whose severities come equally often.
    """
    index, first, parts = np.arange(n), 0, []
    name = setting.task + ("Offset" if setting.hidden_start else "")
    for column in columns:
        generator = np.random.default_rng(zlib.crc32(f"{_SEED} {name} {column.split}".encode()))
        seed = generator.choice(2**29, n, replace=False).astype(np.uint32) + np.uint32(2**29)
        here = tunnels_in(column.split, tunnels)
        severity = index // here % N_LEVELS if faults else 0 * index
        parts.append((seed, first + index % here, severity, index % here))
        first += here
    seed, tunnel, severity, group = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    return Episodes(seed, tunnel.astype(np.int32), severity.astype(np.int32), group.astype(np.int32))
