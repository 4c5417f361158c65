"""Many tunnels at once, made by several processes."""

import concurrent.futures
import functools
import multiprocessing
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from subterra_jax import constants
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.procedural import expand
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.sources import resolve

PLANAR = SENSORS[0]
_EACH = 4  # planar tunnels that take as long to make as a process to begin


def names_of(names: str) -> list[str]:
    """Returns the names in `names`: one, or several as `open:train:0-63`, or names with commas between.

    Raises:
        TunnelError: There is no such tunnel.
    """
    return [name for part in names.split(",") for name in expand(part)]


def load(
    names: Sequence[str | Path | None],
    lining: str | None = None,
    sensor: str = PLANAR,
    stretch: tuple[float, float] | None = None,
) -> list[Tunnel]:
    """Returns the tunnels of these names.

    Args:
        names: Names or files of single tunnels; None is the packaged one.
        lining: Variant of the walls; None is the usual one.
        sensor: The LiDAR; one in three dimensions needs the bore.
        stretch: Start and length of the stretch to cut out of each, m; None keeps the whole.

    Raises:
        TunnelError: There is no such tunnel or lining.
    """
    one = functools.partial(_tunnel, lining=lining, stretch=stretch, spatial=sensor != PLANAR)
    return in_processes(one, list(names), _EACH if sensor == PLANAR else 1)


def in_processes(work: Callable[[Any], Any], items: list[Any], each: int) -> list[Any]:
    """Returns the results of a function of this module or another, by so many processes that each has `each` items."""
    workers = min(-(-len(items) // each), os.cpu_count() or 1)
    if workers <= 1:
        return [work(item) for item in items]
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, context, initializer=_on_cpu) as pool:
        return list(pool.map(work, items, chunksize=1))


def _tunnel(name: str | Path | None, lining: str | None, stretch: tuple[float, float] | None, spatial: bool) -> Tunnel:
    """Returns a tunnel whose arrays are of the host, so that they go from one process to another."""
    return jax.device_get(resolve(name, lining, stretch, constants.RANGE_MAX, spatial))


def _on_cpu() -> None:
    """Keeps a process that makes tunnels away from the accelerator."""
    jax.config.update("jax_platforms", "cpu")
