"""Draws success against wall time: `python -m train.locate.figure RUN [RUN ...] --out curve.png`.

Of each run the share of goals in `val` at which the estimate is right to 1 m, as it trains; of one that takes a map
also with the map, and with the map where the start is hidden. Of a run of `train.navigate` with a memory, dotted, the
success of the last hundred episodes of its training: in other tunnels, and easier at first. Agents of a table of
`benchmarks.kinds` on `val` are level lines.
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from subterra_jax.host.command import parse, run_command
from subterra_jax.host.files import replace_file, require_file
from train.config import ConfigError
from train.locate.keeping import CURVE, LOG
from train.options import read_settings

_CURVES = {"within": "", "mapped": ", with map", "hidden_mapped": ", with map, hidden start"}
_DRIVEN = "GRU that drives"
_STYLES = ("-", "--", "-.", ":")


@dataclasses.dataclass(frozen=True)
class Command:
    """Draws success against wall time.

    Attributes:
        runs: Folders of `train.locate` or `train.navigate`.
        out: File of the figure, `.png`.
        kinds: `kinds.json` of `benchmarks.kinds` on `val`, for level lines.
        agents: Agents of that table to draw; all if left out.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    out: Path
    kinds: Path | None = None
    agents: tuple[str, ...] = ()


def command(arguments: Command) -> None:
    """Draws the figure.

    Raises:
        ConfigError: A run or the table cannot be read.
    """
    require_file(arguments.out, ".png")
    if not arguments.runs:
        raise ConfigError("at least one run must be named")
    curves = {label: curve for run in arguments.runs for label, curve in read_run(run).items()}
    levels = {} if arguments.kinds is None else read_levels(arguments.kinds, arguments.agents)
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8.0, 5.6), layout="constrained")
    for index, (label, seeds) in enumerate(curves.items()):
        for number, curve in enumerate(seeds):
            style: dict[str, Any] = {"ls": ":" if label.startswith(_DRIVEN) else "-", "color": f"C{index}", "lw": 1.5}
            axes.plot(curve[:, 0], 100.0 * curve[:, 1], **style, label=label if number == 0 else None)
    for index, (agent, level) in enumerate(levels.items()):
        axes.axhline(100.0 * level, color="0.4", ls=_STYLES[index % len(_STYLES)], lw=1.0, label=f"{agent} (written)")
    axes.set_xlabel("training, s (compiling too, but for runs of train.locate.compare)")
    axes.set(ylabel="right to 1 m, % of goals in val", ylim=(0.0, 100.0))
    axes.set_xlim(left=0.0)
    axes.grid(alpha=0.3)
    figure.legend(fontsize=8, loc="outside lower center", ncols=2)
    with replace_file(arguments.out) as fresh:
        figure.savefig(fresh, dpi=110, format="png")
    plt.close(figure)
    print(arguments.out)


def read_run(run: Path) -> dict[str, list[np.ndarray]]:
    """Returns the curves of a run by label: of each seed seconds and share of right estimates, `(n, 2)`.

    Raises:
        ConfigError: It is no run of `train.locate` or `train.navigate`, or has no curve.
    """
    settings = read_settings(run / "config.json")
    if (run / LOG).is_file():
        return {_name_of(settings.get("config", {})): [_read_driven(run)]}
    seeds = [
        [json.loads(line) for line in path.read_text().splitlines()] for path in sorted(run.glob(f"seed-*/{CURVE}"))
    ]
    if not seeds or "config" not in settings or any(len(rows) == 0 for rows in seeds):
        raise ConfigError(f"{run}: holds no curve of train.locate")
    config = settings["config"]
    begun = config.get("begin_from")
    label = f"{config['network']}, {config['front']}" + (f", begun from {Path(begun).stem}" if begun else "")
    count = f" ({len(seeds)} seed{'s' * (len(seeds) > 1)})"
    return {
        f"{label}{further}{count}": [np.array([(row["seconds"], row[name]) for row in rows]) for rows in seeds]
        for name, further in _CURVES.items()
        if all(name in row for rows in seeds for row in rows)
    }


def _name_of(config: dict[str, Any]) -> str:
    """Returns the label of a run of `train.navigate`."""
    taught = config.get("teacher")
    return f"{_DRIVEN}, {'PPO by reward' if taught is None else f'taught by {taught}'} (1 seed, its training episodes)"


def _read_driven(run: Path) -> np.ndarray:
    """Returns seconds and success of the last hundred episodes of training, `(n, 2)`, once there are a hundred.

    Raises:
        ConfigError: There is no such line.
    """
    rows = [json.loads(line) for line in (run / LOG).read_text().splitlines()]
    curve = [(row["timing"]["seconds"], row["success_mean_100"]) for row in rows if row.get("episodes", 0) >= 100]
    if not curve:
        raise ConfigError(f"{run}: holds no hundred episodes of train.navigate")
    return np.array(curve)


def read_levels(path: Path, agents: tuple[str, ...]) -> dict[str, float]:
    """Returns the success of agents, the mean over all kinds.

    Raises:
        ConfigError: The file is no table of `benchmarks.kinds` on `val`, or lacks an agent.
    """
    try:
        table: dict[str, Any] = json.loads(path.read_text())
        rows, split = table["rows"], table["config"]["split"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path}: is no table of benchmarks.kinds") from error
    if split != "val":
        raise ConfigError(f"{path}: is of split {split}, the curves are of val")
    if unknown := sorted(set(agents) - set(rows)):
        raise ConfigError(f"{path}: has no agent {unknown[0]!r}; it has {', '.join(rows)}")
    return {agent: float(np.mean([cell["success"] for cell in rows[agent].values()])) for agent in agents or rows}


def main() -> None:
    """Runs `python -m train.locate.figure`."""
    sys.exit(run_command(lambda: command(parse(_read))))


def _read(words: list[str]) -> Command:
    return tyro.cli(Command, args=words, prog="python -m train.locate.figure", description=__doc__)


if __name__ == "__main__":
    main()
