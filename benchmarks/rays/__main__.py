"""Compares ranges of both LiDARs with rays that embree casts in the built mesh.

`python -m benchmarks.rays --scene build/subterra-351 --n 200000 --out out/rays.json`
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.command import BenchmarkError, require_least, run_main
from benchmarks.rays.casting import (
    DEFAULT_SCENE,
    Agreement,
    compare_planar,
    compare_tilted,
    meshed_linings,
    require_scene,
)
from benchmarks.records import Record, measured, write_records
from benchmarks.results import environment_facts, write_file
from subterra_jax.host.files import require_file
from subterra_jax.tunnel.sources import load_tunnel

SCHEMA = "subterra.rays/1"
_progress = Console(stderr=True, highlight=False)


@dataclasses.dataclass(frozen=True)
class RaysConfig:
    """Settings of a comparison. Exit status 1: a goal is missed; 2: the comparison cannot be made."""

    scene: Path = DEFAULT_SCENE  # Folder of a built scene.
    n: int = 200_000  # Rays in each comparison.
    linings: tuple[str, ...] = ()  # Variants of the walls; all that have a mesh if not given.
    kinds: tuple[str, ...] = ("planar", "3d")  # LiDARs to compare.
    seed: int = 0  # Seed for poses and beams.
    out: Path | None = None  # JSON file to write, and `records.json` beside it.


def run(config: RaysConfig) -> tuple[list[Agreement], dict[str, float]]:
    """Makes all comparisons; returns them, and rays per second of the 3-D LiDAR by lining.

    Raises:
        SubterraError: A setting is wrong, the folder lacks a scene or a lining, or the output cannot be written.
    """
    require_least(config, n=1, seed=0)
    if config.out is not None:
        require_file(config.out, ".json")
    for kind in config.kinds:
        if kind not in ("planar", "3d"):
            raise BenchmarkError(f"there is no kind {kind!r}; there are planar and 3d")
    folder = require_scene(config.scene)
    plan = load_tunnel(folder / "tunnel.npz")
    meshed = meshed_linings(folder, plan)
    for lining in config.linings:
        if lining not in meshed:
            raise BenchmarkError(f"{folder}: has no mesh of lining {lining!r}; it has {', '.join(meshed)}")
    comparisons: list[Agreement] = []
    rates: dict[str, float] = {}
    for lining in config.linings or meshed:
        if "planar" in config.kinds:
            _progress.print(f"planar: {lining}")
            comparisons += compare_planar(folder, plan, lining, config.n, config.seed)
        if "3d" in config.kinds:
            _progress.print(f"3-D: {lining}")
            agreement, rates[lining] = compare_tilted(folder, plan, lining, config.n, config.seed)
            comparisons.append(agreement)
    return comparisons, rates


def table(comparisons: list[Agreement]) -> Table:
    """Returns the table of differences, mm."""
    shown = Table(title="differences from embree, mm")
    names = ("comparison", "rays", "median", "99.9 %", "max", "< 1 mm", "< 1 cm", "edges", "< 1 mm without", "goal")
    for name in names:
        shown.add_column(name, justify="left" if name == "comparison" else "right")
    for one in comparisons:
        figures = one.figures()
        whole, plain = figures["all"], figures["without_edges"]
        shown.add_row(
            one.title, f"{figures['n_rays']:,}", *(f"{1e3 * whole[key]:.3g}" for key in ("p50", "p99.9", "max")),
            *(f"{100 * whole[key]:.4f} %" for key in ("within_1mm", "within_1cm")), f"{figures['n_edge']:,}",
            f"{100 * plain.get('within_1mm', 1):.4f} %",
            ("met" if one.holds else "MISSED") if one.judged else "none",
        )  # fmt: skip
    return shown


def write(path: Path, config: RaysConfig, comparisons: list[Agreement], rates: dict[str, float]) -> None:
    """Writes the report as JSON, and its records beside it.

    Raises:
        OutputError: A file cannot be written.
    """
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "config": dataclasses.asdict(config),
        "environment": environment_facts(),
        "comparisons": [one.figures() for one in comparisons],
        "rays_per_second_3d": rates,
    }
    write_file(path, (json.dumps(content, indent=1, default=str) + "\n").encode())
    write_records(path.with_name("records.json"), records_of(config, comparisons))


# Title of a comparison, its quantity, scale and unit: what the documentation shows.
_RECORDS = {
    "rays/planar-median": ("planar, pockets, levelled mesh", "p50", 1e3, "mm"),
    "rays/planar-within-1-cm": ("planar, pockets, levelled mesh", "within_1cm", 100.0, "%"),
    "rays/spatial-median": ("3-D, pockets", "p50", 1e6, "µm"),
}


def records_of(config: RaysConfig, comparisons: list[Agreement]) -> list[Record]:
    """Return the figures that the documentation shows, of the comparisons that were made."""
    found = {one.title: one.figures()["all"] for one in comparisons}
    command = f"benchmarks.rays --scene {config.scene} --out out/rays.json"
    return [
        measured(
            id, round(scale * found[title][name], 3), unit, command, split="pockets, against embree", seed=config.seed
        )
        for id, (title, name, scale, unit) in _RECORDS.items()
        if title in found
    ]


def main(config: RaysConfig) -> int:
    """Compares, prints and writes; returns 1 where a goal is missed."""
    comparisons, rates = run(config)
    console = Console(width=150)
    console.print(table(comparisons))
    for lining, rate in rates.items():
        console.print(f"3-D, {lining}: {rate / 1e6:.3g} M rays/s")
    if config.out is not None:
        write(config.out, config, comparisons, rates)
        console.print(str(config.out))
    return 0 if all(one.holds for one in comparisons) else 1


def command(words: list[str] | None = None) -> int:
    """Runs the command line; returns 1 where a goal is missed, 2 for a user's mistake."""
    return run_main("rays", RaysConfig, main, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(command())
