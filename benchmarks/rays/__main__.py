"""Ranges of both LiDARs against rays that embree casts in the built mesh.

`python -m benchmarks.rays --scene build/subterra-351 --n 200000 --out out/rays.json`
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.command import status
from benchmarks.rays.agreement import Agreement
from benchmarks.rays.errors import RaysError
from benchmarks.rays.figure import histograms
from benchmarks.rays.planar import compare_planar
from benchmarks.rays.scenefiles import DEFAULT_SCENE, meshed_linings, require_scene
from benchmarks.rays.tilted import compare_tilted
from benchmarks.throughput.facts import environment_facts
from scene.arguments import parse
from subterra_jax.outputs import require_file
from subterra_jax.tunnel.sources import load_tunnel

SCHEMA = "subterra.rays/1"
_progress = Console(stderr=True, highlight=False)


@dataclasses.dataclass(frozen=True)
class RaysConfig:
    """What to compare. Exit status 1: a goal is missed; 2: the comparison cannot be made.

    Attributes:
        scene: Folder of a built scene.
        n: Rays of each comparison.
        linings: Variants of the walls; all that have a mesh if not given.
        kinds: Which LiDARs.
        seed: Of poses and beams.
        out: JSON file to write; a figure with the histograms goes beside it.
    """

    scene: Path = DEFAULT_SCENE
    n: int = 200_000
    linings: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ("planar", "3d")
    seed: int = 0
    out: Path | None = None


def run(config: RaysConfig) -> tuple[list[Agreement], dict[str, float]]:
    """All comparisons, and rays per second of the 3-D LiDAR by lining.

    Raises:
        SubterraError: The folder is no scene, or lacks what was asked for; or the output cannot be written.
    """
    for name, least in (("n", 1), ("seed", 0)):
        if getattr(config, name) < least:
            raise RaysError(f"{name} must be at least {least}, got {getattr(config, name)}")
    if config.out is not None:
        require_file(config.out, ".json")
    for kind in config.kinds:
        if kind not in ("planar", "3d"):
            raise RaysError(f"there is no kind {kind!r}; there are planar and 3d")
    folder = require_scene(config.scene)
    plan = load_tunnel(folder / "tunnel.npz")
    there = meshed_linings(folder, plan)
    for lining in config.linings:
        if lining not in there:
            raise RaysError(f"{folder}: has no mesh of lining {lining!r}; it has {', '.join(there)}")
    found: list[Agreement] = []
    rates: dict[str, float] = {}
    for lining in config.linings or there:
        if "planar" in config.kinds:
            _progress.print(f"planar: {lining}")
            found += compare_planar(folder, plan, lining, config.n, config.seed)
        if "3d" in config.kinds:
            _progress.print(f"3-D: {lining}")
            agreement, rates[lining] = compare_tilted(folder, plan, lining, config.n, config.seed)
            found.append(agreement)
    return found, rates


def table(found: list[Agreement]) -> Table:
    """Differences in mm."""
    shown = Table(title="differences from embree, mm")
    for name in ("comparison", "rays", "median", "99 %", "99.9 %", "max", "< 1 cm", "edges", "< 1 cm without", "goal"):
        shown.add_column(name, justify="left" if name == "comparison" else "right")
    for one in found:
        figures = one.figures()
        whole, plain = figures["all"], figures["without_edges"]
        shown.add_row(
            one.title, f"{figures['n_rays']:,}", *(f"{1e3 * whole[key]:.3g}" for key in ("p50", "p99", "p99.9", "max")),
            f"{100 * whole['within_1cm']:.3f} %", f"{figures['n_edge']:,}", f"{100 * plain.get('within_1cm', 1):.3f} %",
            ("met" if one.holds else "MISSED") if one.judged else "none",
        )  # fmt: skip
    return shown


def write(path: Path, config: RaysConfig, found: list[Agreement], rates: dict[str, float]) -> None:
    """The report as JSON, and its figure beside it.

    Raises:
        RaysError: The place cannot be written to.
    """
    content: dict[str, Any] = {
        "schema": SCHEMA,
        "config": dataclasses.asdict(config),
        "environment": environment_facts(),
        "comparisons": [one.figures() for one in found],
        "rays_per_second_3d": rates,
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.partial")
        partial.write_text(json.dumps(content, indent=1, default=str) + "\n")
        partial.replace(path)
        histograms(found).savefig(path.with_suffix(".png"), dpi=130)
    except OSError as error:
        raise RaysError(f"{path}: cannot be written ({error.strerror})") from error


def main(config: RaysConfig) -> int:
    """Runs the command; the exit status."""
    found, rates = run(config)
    console = Console(width=150)
    console.print(table(found))
    for lining, rate in rates.items():
        console.print(f"3-D, {lining}: {rate / 1e6:.3g} M rays/s")
    if config.out is not None:
        write(config.out, config, found, rates)
        console.print(str(config.out))
    return 0 if all(one.holds for one in found) else 1


def command(arguments: list[str] | None = None) -> int:
    """The command line; a user's mistake is one sentence and status 2."""
    config = parse(
        lambda words: tyro.cli(RaysConfig, args=words, prog="python -m benchmarks.rays", description=__doc__), arguments
    )
    return status(lambda: main(config))


if __name__ == "__main__":
    sys.exit(command())
