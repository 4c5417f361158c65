"""Tables and picture of the leaderboard of version 1, and which of its figures would be leaks."""

import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.command import BenchmarkError
from benchmarks.openboard.columns import AGENTS, SCHEMA, TASKS
from benchmarks.results import png_bytes
from subterra_jax.evaluation.floor import is_above
from subterra_jax.evaluation.records import grouped, interval

BLIND = ("dead-reckoning", "fused")  # steer by the walls, and never localise by them
CEILING = "ceiling"
TUNED_ON = {
    "dead-reckoning": "nothing",
    "fused": "nothing; told the sizes of the errors",
    "ring-count": "`subterra-351`, older family",
    "ring-filter": "`subterra-351`, older family",
    "scan-matching": "`subterra-351`, older family",
    "particle-filter": "`subterra-351`, older family; has the map",
    "histogram-filter": "nothing; has the map, told the sizes of the errors",
    CEILING: "nothing; has the map, the sizes of errors and of the episode's faults",
}
_COLOURS = {
    "ring-count": "#e09f3e",
    "ring-filter": "#c1121f",
    "scan-matching": "#8367c7",
    "particle-filter": "#1b4965",
    "histogram-filter": "#2a9d8f",
}


def read_cells(source: Path, conditions: Collection[str]) -> list[dict[str, Any]]:
    """Read the cells that were driven under some conditions, in the order of tasks and agents.

    Args:
        source: Folder with a file for each cell, or a file with a line for each.
        conditions: Digests of the conditions: those of all splits, and of a few of them.

    Raises:
        BenchmarkError: There is none, or a line is no cell.
    """
    try:
        texts = (
            source.read_text().splitlines()
            if source.is_file()
            else [file.read_text() for file in sorted(source.glob("*.json"))]
        )
        cells = [json.loads(text) for text in texts]
        cells = [cell for cell in cells if cell.get("schema") == SCHEMA and cell["conditions"] in conditions]
    except (ValueError, AttributeError, KeyError) as error:
        raise BenchmarkError(f"{source}: holds something that is no cell of the board") from error
    if not cells:
        raise BenchmarkError(f"{source}: holds no cell of these tunnels, episodes and constants")
    place = lambda names, name: names.index(name) if name in names else len(names)  # noqa: E731
    return sorted(cells, key=lambda cell: (place(TASKS, cell["task"]), place(AGENTS, cell["agent"]), cell["agent"]))


def summarise(cell: dict[str, Any]) -> list[dict[str, Any]]:
    """Return for each column success, its 95 % interval over tunnels and episodes, contact, median error (m), floor."""
    tunnels, columns = cell["tunnels"], cell["columns"]
    success = np.array(cell["success"], float).reshape(len(columns), -1)
    contact = np.array(cell["contact"], float).reshape(len(columns), -1)
    error = np.array([np.nan if e is None else e for e in cell["goal_error"]], float).reshape(len(columns), -1)
    bound = np.array(cell["floor"], float).reshape(len(columns), tunnels).mean(axis=1)
    rows = []
    for i, column in enumerate(columns):
        group = np.arange(success.shape[1]) % tunnels
        low, high = interval(grouped(success[i], group), lambda s: s.mean(axis=(-2, -1)))
        stopped = np.abs(error[i][~np.isnan(error[i]) & (contact[i] == 0.0)])
        rows.append(
            {
                **column,
                "success": float(success[i].mean()),
                "low": low,
                "high": high,
                "contact": float(contact[i].mean()),
                "median_error": float(np.median(stopped)) if len(stopped) else None,
                "floor": float(bound[i]),
                "n": success.shape[1],
            }
        )
    return rows


def rows_of(cells: list[dict[str, Any]], task: str) -> dict[str, dict[tuple[str, str], dict[str, Any]]]:
    """Return for each agent of a task the rows of `summarise` by split and kind, of all splits it was driven in."""
    rows: dict[str, dict[tuple[str, str], dict[str, Any]]] = {}
    for cell in cells:
        if cell["task"] == task:
            rows.setdefault(cell["agent"], {}).update({(r["split"], r["kind"]): r for r in summarise(cell)})
    return rows


def columns_of(cells: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """Return split and kind of all columns, those of the cell with most of them first."""
    widest = sorted(cells, key=lambda cell: -len(cell["columns"]))
    return list(dict.fromkeys((column["split"], column["kind"]) for cell in widest for column in cell["columns"]))


def tasks_of(cells: list[dict[str, Any]]) -> list[str]:
    """Return the tasks in their order."""
    return list(dict.fromkeys(cell["task"] for cell in cells))


def find_leaks(cells: list[dict[str, Any]]) -> list[str]:
    """Name the figures beyond a bound: a blind agent above the floor, or any agent above the ceiling.

    A figure is beyond where the difference is more than four standard errors of the two: a table has some hundred.
    """
    found = []
    for task in tasks_of(cells):
        rows = rows_of(cells, task)
        for agent, of_agent in rows.items():
            for (split, kind), row in of_agent.items():
                where = f"{agent}, {task}, {kind} of {split}"
                if agent in BLIND and is_above(row["success"], row["floor"], row["n"], 0):
                    found.append(f"{where}: {_percent(row['success'])} is above the floor, {_percent(row['floor'])}")
                top = rows.get(CEILING, {}).get((split, kind))
                if top is not None and is_above(row["success"], top["success"], row["n"], top["n"]):
                    found.append(
                        f"{where}: {_percent(row['success'])} is above the ceiling, {_percent(top['success'])}"
                    )
    return found


def as_markdown(cells: list[dict[str, Any]]) -> str:
    """Return one table for each split and task: success in %, its interval, median error at the stop in m."""
    leaks = find_leaks(cells)
    facts = cells[0]["facts"]
    devices = ", ".join(dict.fromkeys(cell["facts"]["device"] for cell in cells))
    lines = [
        f"Version 1, constants `{facts['constants_sha256'][:12]}`, {cells[0]['tunnels']} tunnels and "
        f"{len(cells[0]['success']) // len(cells[0]['columns'])} episodes of each kind and split; {devices}.",
        "Success in %, its 95 % interval, median error at the stop in m.",
        "",
        "Beyond a bound: " + ("; ".join(leaks) if leaks else "nobody") + ".",
    ]
    columns = columns_of(cells)
    for split in dict.fromkeys(split for split, _ in columns):
        for task in tasks_of(cells):
            rows = {
                agent: [r for r in some.values() if r["split"] == split] for agent, some in rows_of(cells, task).items()
            }
            rows = {agent: some for agent, some in rows.items() if some}
            if not rows:
                continue
            first = next(iter(rows.values()))
            kinds, bounds = " | ".join(r["kind"] for r in first), " | ".join(f"{100 * r['floor']:.0f}" for r in first)
            lines += [
                "",
                f"### {task}, {split}",
                "",
                f"| agent | tuned on | {kinds} |",
                "|---|---|" + "---|" * len(first),
            ]
            lines.append(f"| floor, in theory | | {bounds} |")
            for agent, some in rows.items():
                lines.append(f"| {agent} | {TUNED_ON.get(agent, 'not known')} | " + " | ".join(map(_cell, some)) + " |")
    return "\n".join(lines) + "\n"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _cell(row: dict[str, Any]) -> str:
    error = "-" if row["median_error"] is None else f"{row['median_error']:.2f}"
    contact = f", contact {100 * row['contact']:.0f}" if row["contact"] else ""
    return f"{100 * row['success']:.0f} ({100 * row['low']:.0f}-{100 * row['high']:.0f}), {error}{contact}"


def draw(cells: list[dict[str, Any]]) -> Figure:
    """Draw one panel a task: for each kind and split a bar from floor to ceiling, and a dot for each agent."""
    tasks, columns = tasks_of(cells), columns_of(cells)
    n_columns = min(3, len(tasks))
    shape = (-(-len(tasks) // n_columns), n_columns)
    figure, grid = plt.subplots(
        *shape, figsize=(1.0 + 4.6 * shape[1], 0.8 + 2.9 * shape[0]), squeeze=False, layout="constrained", sharey=True
    )
    for axes, task in zip(grid.flat, tasks, strict=False):
        _panel(axes, task, rows_of(cells, task), columns)
    for axes in list(grid.flat)[len(tasks) :]:
        axes.axis("off")
    for axes in grid[:, 0]:
        axes.set_ylabel("success, %")
    handles, names = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=6, fontsize=8)
    figure.suptitle(
        "Grey bar: from the floor (no look at the walls) to the ceiling (map and every size known)", fontsize=10
    )
    return figure


def _panel(
    axes: Any, task: str, rows: dict[str, dict[tuple[str, str], dict[str, Any]]], columns: list[tuple[str, str]]
) -> None:
    place = np.arange(len(columns))
    floors = {column: row["floor"] for some in rows.values() for column, row in some.items()}
    shares = lambda some, name, other: 100.0 * np.array([some[c][name] if c in some else other for c in columns])  # noqa: E731
    bottom = 100.0 * np.array([floors.get(column, np.nan) for column in columns])
    top = shares(rows.get(CEILING, {}), "success", 1.0)
    axes.bar(place, np.maximum(top - bottom, 0.0), 0.8, bottom, color="#dddddd", label="floor to ceiling")
    for agent, some in rows.items():
        if agent not in (CEILING, *BLIND):
            colour = _COLOURS.get(agent, "black")
            axes.plot(place, shares(some, "success", np.nan), "o", ms=4.5, color=colour, label=agent)
    axes.set_title(task, fontsize=10)
    axes.set_ylim(0.0, 112.0)  # room for the names of the splits
    axes.set_xticks(place, [kind for _, kind in columns], rotation=90, fontsize=7)
    splits = [split for split, _ in columns]
    for i in range(1, len(columns)):
        if splits[i] != splits[i - 1]:
            axes.axvline(i - 0.5, color="black", lw=0.8)
    for split in dict.fromkeys(splits):
        here = [i for i, one in enumerate(splits) if one == split]
        axes.text(np.mean(here), 103.0, split, ha="center", va="bottom", fontsize=7)
    axes.grid(axis="y", alpha=0.3)


def as_png(cells: list[dict[str, Any]]) -> bytes:
    """Return the picture as a PNG file."""
    return png_bytes(draw(cells), dpi=120)
