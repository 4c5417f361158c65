"""Ablations of agents without learning: another ring length told, smooth walls, rows in no plane, other wet rail.

`python -m benchmarks.openboard.ablations --out out/ablations`

Each row changes one thing of T1 or T4 of version 1; agents assume what they always assume.
"""

import dataclasses
import json
import sys
import zlib
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from rich.console import Console

import subterra_jax as st
from benchmarks.command import BenchmarkError, require_least, run_main
from benchmarks.results import environment_facts, write_file
from subterra_jax.baselines import registry
from subterra_jax.evaluation import Episodes, evaluate
from subterra_jax.evaluation.floor import floor
from subterra_jax.evaluation.records import grouped, interval
from subterra_jax.host.files import require_folder
from subterra_jax.parts import Faults
from subterra_jax.parts.faults import SIZES, FaultState
from subterra_jax.rules import ToldParams

SCHEMA = "subterra.ablations/1"
N_GROUPS = 10
_WET = SIZES.index("wet_loss")
_progress = Console(stderr=True, highlight=False)


@dataclasses.dataclass(frozen=True)
class WetRail(Faults):
    """Faults whose loss on wet rail is chosen, while agents assume the middle of its range.

    Attributes:
        factor: Loss over the middle of its range, 1.
    """

    factor: float = 1.0

    def begin(self, draw: Any, state: Any, params: Any) -> FaultState:
        """Begin as `Faults`, the loss apart."""
        begun = super().begin(draw, state, params)
        return dataclasses.replace(begun, scale=begun.scale.at[_WET].set(jnp.float32(self.factor)))


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of the table.

    Attributes:
        words: What is changed.
        tunnel: Tunnel, or a family.
        lining: Variant of the walls; None is the tunnel's first.
        pitch_error: Relative error of the ring length told, 1.
        wet_loss: Share of the speed lost on wet rail; None for T1, without faults.
    """

    words: str
    tunnel: str = "subterra-351"
    lining: str | None = None
    pitch_error: float = 0.0
    wet_loss: float | None = None


ROWS = (
    Row("pockets in the plane, ring length exact"),
    *(
        Row(f"ring length told {100 * e:+.1f} % off", pitch_error=e)
        for e in (0.003, 0.005, 0.01, -0.003, -0.005, -0.01)
    ),
    Row("smooth walls", lining="smooth"),
    Row("`metro-asbuilt`, pockets in the plane", "metro-asbuilt"),
    Row("`metro-asbuilt`, walls as surveyed", "metro-asbuilt", "smooth"),
    Row("`subterra-universal`, rings turned", "subterra-universal"),
    Row("`subterra-universal`, smooth walls", "subterra-universal", "smooth"),
    Row("`open:straight:val`, rows where they fall", "open:straight:val:0-9"),
    *(Row(f"faults, wet rail loses {loss:.1f} (assumed: 0.3)", wet_loss=loss) for loss in (0.2, 0.3, 0.4)),
)


@dataclasses.dataclass(frozen=True)
class AblationsConfig:
    """Settings of the ablations.

    Attributes:
        out: Folder for `ablations.json` and `ablations.md`.
        agents: Names of agents.
        episodes: Episodes of each row; the same seeds for all.
        only: Words of the rows to drive, such as `wet rail`; all rows if not given.
    """

    out: Path
    agents: tuple[str, ...] = ("fused", "ring-count", "ring-filter", "particle-filter")
    episodes: int = 200
    only: str = ""


def run(config: AblationsConfig) -> None:
    """Drives every row, and writes the table after each.

    Raises:
        SubterraError: An agent is unknown, or the folder cannot be written.
    """
    require_least(config, episodes=2)
    for agent in config.agents:
        if agent not in registry.names():
            raise BenchmarkError(f"no agent {agent!r}; there are {', '.join(registry.names())}")
    wanted = [row for row in ROWS if config.only in row.words]
    if not wanted:
        raise BenchmarkError(f"no row with the words {config.only!r}; there are {'; '.join(row.words for row in ROWS)}")
    require_folder(config.out)
    rows: list[dict[str, Any]] = []
    for row in wanted:
        rows.append(drive(row, config))
        _progress.print(as_line(rows[-1], config.agents))
        content = {"schema": SCHEMA, "rows": rows, "facts": environment_facts(), "episodes": config.episodes,
                   "constants_sha256": st.constants_digest()}  # fmt: skip
        write_file(config.out / "ablations.json", (json.dumps(content, indent=1) + "\n").encode())
    head = "| what is changed | floor | " + " | ".join(config.agents) + " |\n|---|---|" + "---|" * len(config.agents)
    text = "\n".join([head, *(as_line(row, config.agents) for row in rows)]) + "\n"
    write_file(config.out / "ablations.md", text.encode())
    print(config.out / "ablations.md")


def drive(row: Row, config: AblationsConfig) -> dict[str, Any]:
    """Return success and its 95 % interval of each agent under the conditions of a row."""
    task = "StopAt" if row.wet_loss is None else "Faulted"
    env, params = st.make(
        f"Subterra/{task}-v1", row.tunnel, row.lining, estimates=True, told=ToldParams(pitch_error=row.pitch_error)
    )
    if row.wet_loss is not None:
        factor = row.wet_loss / float(params.faults.wet_loss)
        parts = tuple(WetRail(factor=factor) if isinstance(part, Faults) else part for part in env.parts)
        env = dataclasses.replace(env, parts=parts)
    n = config.episodes
    index = np.arange(n, dtype=np.int32)
    seeds = np.random.default_rng(zlib.crc32(f"{SCHEMA} {task}".encode())).choice(2**29, n, replace=False)
    severity = index % 5 if row.wet_loss is not None else 0 * index
    group = (index * N_GROUPS // max(n, N_GROUPS)).astype(np.int32)
    episodes = Episodes((seeds + 2**29).astype(np.uint32), index % params.tunnel.count, severity, group)
    found: dict[str, Any] = {**dataclasses.asdict(row), "agents": {}}
    found["floor"] = float(np.mean([floor(params, i) for i in range(params.tunnel.count)]))
    for agent in config.agents:
        records = evaluate(env, params, registry.make_agent(agent, params), episodes, n)
        low, high = interval(grouped(records.success.astype(float), group), lambda s: s.mean(axis=(-2, -1)))
        found["agents"][agent] = {"success": float(records.success.mean()), "low": low, "high": high}
    return found


def as_line(row: dict[str, Any], agents: tuple[str, ...]) -> str:
    """Return a row of the table: success in % with its interval."""
    cells = [
        f"{100 * one['success']:.0f} ({100 * one['low']:.0f} to {100 * one['high']:.0f})"
        for one in (row["agents"][agent] for agent in agents)
    ]
    return f"| {row['words']} | {100 * row['floor']:.0f} | " + " | ".join(cells) + " |"


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("openboard.ablations", AblationsConfig, run, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(main())
