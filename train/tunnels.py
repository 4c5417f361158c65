"""Many tunnels at once, made by several processes."""

import concurrent.futures
import dataclasses
import functools
import multiprocessing
import os
import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from subterra_jax import constants
from subterra_jax.host.files import replace_file
from subterra_jax.host.versions import VERSION
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.procedural import expand
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.sources import resolve

PLANAR = SENSORS[0]
_FORM = 2  # of the arrays of a tunnel: what was kept in another is not read
_EACH = 4  # planar tunnels that take as long to make as a process to begin


@dataclasses.dataclass(frozen=True)
class Kind:
    """Lining, bore and piece of a tunnel to make."""

    lining: str | None  # variant of the walls; None is the usual one
    spatial: bool  # make the bore in three dimensions too
    piece: tuple[float, float] | None  # start and length of the piece to cut out, m; None keeps the whole


def names_of(names: str) -> list[str]:
    """Returns the names in `names`: one, or several as `open:train:0-63`, or names with commas between.

    Raises:
        TunnelError: There is no such tunnel.
    """
    return [name for part in names.split(",") for name in expand(part)]


def load(
    names: Sequence[str | Path | None],
    lining: str | None = None,
    cache: Path | None = None,
    sensor: str = PLANAR,
    piece: tuple[float, float] | None = None,
) -> list[Tunnel]:
    """Returns the tunnels of these names.

    Args:
        names: Names or files of single tunnels; None is the packaged one.
        lining: Variant of the walls; None is the usual one.
        cache: Folder of this command's own in which tunnels are kept from run to run; None keeps none.
        sensor: The LiDAR; one in three dimensions needs the bore.
        piece: Start and length of the piece to cut out of each, m; None keeps the whole.

    Raises:
        TunnelError: There is no such tunnel or lining.
    """
    kind = Kind(lining, sensor != PLANAR, piece)
    one = functools.partial(_tunnel, kind=kind, cache=cache)
    missing = [name for name in names if not _is_kept(name, kind, cache)]
    made = dict(zip(missing, in_processes(one, missing, 1 if kind.spatial else _EACH), strict=True))
    return [made[name] if name in made else one(name) for name in names]


def in_processes(work: Callable[[Any], Any], items: list[Any], each: int) -> list[Any]:
    """Returns the results of a function of this module or another, by so many processes that each has `each` items."""
    workers = min(-(-len(items) // each), os.cpu_count() or 1)
    if workers <= 1:
        return [work(item) for item in items]
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, context, initializer=_on_cpu) as pool:
        return list(pool.map(work, items, chunksize=1))


def _tunnel(name: str | Path | None, kind: Kind, cache: Path | None) -> Tunnel:
    """Returns a tunnel whose arrays are of the host, so that they go from one process to another."""
    kept = _cache_file(name, kind, cache)
    if kept is not None and kept.is_file():
        return pickle.loads(kept.read_bytes())
    made = jax.device_get(resolve(name, kind.lining, kind.piece, constants.RANGE_MAX, kind.spatial))
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        with replace_file(kept) as fresh:
            fresh.write_bytes(pickle.dumps(made))
    return made


def _cache_file(name: str | Path | None, kind: Kind, cache: Path | None) -> Path | None:
    """Returns the file in which a tunnel is kept."""
    bore, piece = "-bore" if kind.spatial else "", "" if kind.piece is None else f"-{kind.piece}"
    return (
        None
        if cache is None
        else cache / f"{VERSION}-{_FORM}-{name}-{kind.lining}{bore}{piece}.pickle".replace("/", "_")
    )


def _is_kept(name: str | Path | None, kind: Kind, cache: Path | None) -> bool:
    kept = _cache_file(name, kind, cache)
    return kept is not None and kept.is_file()


def _on_cpu() -> None:
    """Keeps a process that makes tunnels away from the accelerator."""
    jax.config.update("jax_platforms", "cpu")
