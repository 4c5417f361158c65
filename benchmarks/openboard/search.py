"""Search for the settings of an agent on `val`, by a fixed list of candidates: what agents of the board were tuned on.

`python -m benchmarks.openboard.search scan-matching --out out/search`

The tunnels are the first of `val`; the leaderboard's `val` columns begin behind them. The default comes first; another
candidate replaces it where it is better by two standard errors.
"""

import dataclasses
import itertools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console

import subterra_jax as st
from benchmarks.command import BenchmarkError, require_least, run_main
from benchmarks.openboard.columns import FIRST, columns_of
from benchmarks.results import environment_facts, write_file
from subterra_jax.baselines import registry
from subterra_jax.evaluation import Episodes, evaluate
from subterra_jax.host.files import require_folder

SCHEMA = "subterra.search/1"
_SEEDS = 2**28  # below those of the leaderboard
_progress = Console(stderr=True, highlight=False)

# Agent: where its settings are (field within field), and the values of each that are tried.
SPACES: dict[str, tuple[str, dict[str, tuple[float, ...]]]] = {
    "scan-matching": (
        "localiser.params",
        {"wall_sigma": (0.05, 0.02, 0.1), "least_information": (5000.0, 1000.0, 20000.0), "least_age": (1.0, 3.0)},
    ),
    "ring-filter": ("steering", {"cruise": (1.2, 0.8, 2.0), "slow": (0.5, 1.0), "learning": (15.0, 30.0)}),
    "particle-filter": (
        "localiser.scan",
        {"map_sigma": (0.01, 0.03), "power": (0.5, 0.25, 1.0), "outlier_share": (0.05, 0.15)},
    ),
}


@dataclasses.dataclass(frozen=True)
class SearchConfig:
    """Settings of a search.

    Attributes:
        agent: Name of the agent.
        out: Folder for `AGENT.json`.
        task: Task of version 1, without `Subterra/` and `-v1`.
        episodes: Episodes of each kind, the same for every candidate.
        tunnels: Tunnels of each kind.
    """

    agent: Annotated[str, tyro.conf.Positional]
    out: Path
    task: str = "StopAt"
    episodes: int = 100
    tunnels: int = 5


def run(config: SearchConfig) -> None:
    """Tries every candidate, and writes what each scores.

    Raises:
        SubterraError: There is nothing to search for, or the folder cannot be written.
    """
    require_least(config, episodes=2, tunnels=1)
    if config.agent not in SPACES:
        raise BenchmarkError(f"no settings of {config.agent!r} are searched for; there are {', '.join(SPACES)}")
    if config.tunnels > FIRST["val"]:
        raise BenchmarkError(f"tunnels must be at most {FIRST['val']}, where those of the leaderboard begin")
    require_folder(config.out)
    kinds = [column.kind for column in columns_of(("val",))]
    names = [f"open:{kind}:val:{i}" for kind in kinds for i in range(config.tunnels)]
    env, params = st.make(f"Subterra/{config.task}-v1", names, estimates=True)
    n = config.episodes * len(kinds)
    index = np.arange(n, dtype=np.int32)
    kind = index // config.episodes
    tunnel = kind * config.tunnels + index % config.tunnels
    episodes = Episodes((_SEEDS + index % config.episodes).astype(np.uint32), tunnel, 0 * index, kind)
    rows: list[dict[str, Any]] = []
    for settings in candidates(config.agent):
        records = evaluate(env, params, with_settings(config.agent, settings)(params), episodes, n)
        success = [float(records.success[kind == k].mean()) for k in range(len(kinds))]
        rows.append({"settings": settings, "success": float(records.success.mean()),
                     "by_kind": dict(zip(kinds, success, strict=True))})  # fmt: skip
        _progress.print(f"{settings}: {100 * rows[-1]['success']:.1f} %")
        content = {"schema": SCHEMA, "agent": config.agent, "task": config.task, "tunnels": names, "rows": rows,
                   "episodes": n, "chosen": choose(rows, n), "facts": environment_facts()}  # fmt: skip
        write_file(config.out / f"{config.agent}.json", (json.dumps(content, indent=1) + "\n").encode())
    print(f"{config.agent}: {choose(rows, n)}")


def candidates(agent: str) -> list[dict[str, float]]:
    """Return the candidates of an agent, its default first."""
    space = SPACES[agent][1]
    return [dict(zip(space, values, strict=True)) for values in itertools.product(*space.values())]


def with_settings(agent: str, settings: dict[str, float]) -> Callable[[Any], Any]:
    """Return a factory of the agent with other settings."""

    def make(params: Any) -> Any:
        return _replace(registry.make_agent(agent, params), SPACES[agent][0].split("."), settings)

    return make


def _replace(made: Any, path: list[str], settings: dict[str, float]) -> Any:
    """Return what was made with other settings at the end of a path of fields."""
    if not path:
        return made.replace(**settings)
    return made.replace(**{path[0]: _replace(getattr(made, path[0]), path[1:], settings)})


def choose(rows: list[dict[str, Any]], n: int) -> dict[str, float]:
    """Return the best settings, or the first, the default, where no other is better by two standard errors."""
    best, default = max(rows, key=lambda row: row["success"]), rows[0]
    share = default["success"]
    error = np.sqrt(max(share * (1.0 - share), 0.25 / n) * 2.0 / n)
    return best["settings"] if best["success"] - share > 2.0 * error else default["settings"]


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("openboard.search", SearchConfig, run, description=__doc__, words=words)


if __name__ == "__main__":
    sys.exit(main())
