"""Scores of all entries, and the leaderboard as Markdown, JSON and a figure."""

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from benchmarks.command import BenchmarkError
from benchmarks.leaderboard.entries import Entry
from benchmarks.results import png_bytes
from subterra_jax.baselines.registry import CEILING, DEAD_RECKONING
from subterra_jax.evaluation.episodes import SHA256
from subterra_jax.evaluation.records import grouped, interquartile_mean, interval, normalised, summarise

_SEED = 0  # of the bootstrap


def scores(entries: list[Entry]) -> list[dict[str, Any]]:
    """Returns one row for each entry: task, tunnel, agent, its inputs, its summary and its normalised score."""
    rows = []
    for entry in entries:
        row: dict[str, Any] = {"task": entry.task, "world": entry.world, "agent": entry.agent, **entry.traits}
        row |= summarise(entry.records, _SEED)
        floor, ceiling = _success_of(entries, entry, DEAD_RECKONING), _success_of(entries, entry, CEILING)
        row["bounds"], row["normalised"] = entry.bounds, None
        if floor is not None and ceiling is not None:
            row["normalised"] = normalised(row["success"], floor, ceiling)
        rows.append(row)
    return rows


def totals(entries: list[Entry]) -> list[dict[str, Any]]:
    """Returns one row for each agent in each tunnel: inter-quartile mean of its normalised scores over all tasks.

    Tasks on which dead reckoning does as well as the oracle are left out. Every group of episodes of every task is one
    score; the interval draws groups within tasks.
    """
    rows = []
    for world, agent in dict.fromkeys((e.world, e.agent) for e in entries):
        groups = [g for e in entries if (e.world, e.agent) == (world, agent) and (g := _groups(entries, e)) is not None]
        if not groups:
            continue
        size = min(len(g) for g in groups)
        table = np.stack([g[:size] for g in groups])
        low, high = interval(table, _means, _SEED)
        score = {"normalised_iqm": interquartile_mean(table.ravel()), "low": low, "high": high}
        rows.append({"world": world, "agent": agent, "tasks": len(table), **score})
    return sorted(rows, key=lambda row: (row["world"], -row["normalised_iqm"]))


def _groups(entries: list[Entry], entry: Entry) -> np.ndarray | None:
    """Returns the normalised score of each group of episodes; `None` where dead reckoning equals the oracle."""
    floor, ceiling = _success_of(entries, entry, DEAD_RECKONING), _success_of(entries, entry, CEILING)
    if floor is None or ceiling is None or normalised(ceiling, floor, ceiling) is None:
        return None
    means = grouped(entry.records.success.astype(float), entry.records.group).mean(axis=1)
    return (means - floor) / (ceiling - floor)


def _means(tables: np.ndarray) -> np.ndarray:
    """Returns the inter-quartile mean of each table in a stack."""
    return np.array([interquartile_mean(table.ravel()) for table in tables])


def _success_of(entries: list[Entry], like: Entry, agent: str) -> float | None:
    """Returns the success of another agent in the same task and tunnel."""
    for entry in entries:
        if (entry.task, entry.world, entry.agent) == (like.task, like.world, agent):
            return float(entry.records.success.mean())
    return None


SCHEMA = "subterra.leaderboard/1"
_DETAILS = (
    ("success", "success %", 100.0, 1), ("success_iqm", "IQM %", 100.0, 1),
    ("contacts_per_100m", "contacts / 100 m", 1.0, 2), ("spl", "SPL", 1.0, 3),
    ("coverage", "coverage %", 100.0, 2), ("progress", "progress %", 100.0, 2), ("clearance", "clearance, m", 1.0, 2),
    ("offset", "\\|d\\|/w", 1.0, 3), ("time", "time, s", 1.0, 0), ("jerk", "jerk", 1.0, 3),
    ("goal_error", "goal error, m", 1.0, 2), ("axial_final", "axial, m", 1.0, 2), ("axial_rms", "axial RMS, m", 1.0, 2),
    ("lateral", "lateral RMS, m", 1.0, 2), ("drift", "drift %", 1.0, 2), ("time_to_lock", "lock, s", 1.0, 0),
    ("cycle_slips", "slips", 1.0, 1), ("crps", "CRPS, m", 1.0, 3), ("nees", "NEES", 1.0, 2),
    ("success_area", "area", 1.0, 3), ("normalised", "normalised", 1.0, 3),
)  # fmt: skip


def as_json(rows: list[dict[str, Any]], overall: list[dict[str, Any]], facts: dict[str, Any]) -> str:
    """Returns `leaderboard.json`."""
    content = {"schema": SCHEMA, "evaluation_sha256": SHA256, **facts, "scores": rows, "totals": overall}
    return json.dumps(content, indent=1, allow_nan=False, default=str) + "\n"


def as_markdown(rows: list[dict[str, Any]], overall: list[dict[str, Any]], facts: dict[str, Any]) -> str:
    """Returns `leaderboard.md`."""
    parts = [
        "# Leaderboard",
        f"{facts['episodes']} episodes a task of the evaluation list with SHA-256 `{SHA256}`; {facts['device']}, "
        f"jax {facts['jax']}. Success in % with the 95 % interval of a bootstrap stratified over groups of episodes.",
    ]
    for world in dict.fromkeys(row["world"] for row in rows):
        here = [row for row in rows if row["world"] == world]
        parts += [f"## {world}", _overview(here), _totals([row for row in overall if row["world"] == world])]
        for task in dict.fromkeys(row["task"] for row in here):
            mine = [row for row in here if row["task"] == task]
            parts += [f"### {task}", _details(mine), _bounds(mine[0]["bounds"])]
    return "\n\n".join(part for part in parts if part) + "\n"


def _overview(rows: list[dict[str, Any]]) -> str:
    """Returns the table of success, agents down and tasks across."""
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    lines = [["agent", "sees", *(_short(task) for task in tasks)]]
    for agent in dict.fromkeys(row["agent"] for row in rows):
        mine = {row["task"]: row for row in rows if row["agent"] == agent}
        lines.append([agent, _inputs(list(mine.values())), *(_success(mine.get(task)) for task in tasks)])
    return _table(lines)


def _totals(rows: list[dict[str, Any]]) -> str:
    """Returns the table of scores over all tasks."""
    if not rows:
        return ""
    head = "Normalised score, 0 for dead reckoning and 1 for the oracle; inter-quartile mean over tasks and groups:"
    lines = [["agent", "score", "95 % interval", "tasks"]]
    for row in rows:
        interval = f"{row['low']:.3f} to {row['high']:.3f}"
        lines.append([row["agent"], f"{row['normalised_iqm']:.3f}", interval, str(row["tasks"])])
    return f"{head}\n\n{_table(lines)}"


def _details(rows: list[dict[str, Any]]) -> str:
    """Returns the table of every quantity that an agent has in a task."""
    shown = [detail for detail in _DETAILS if any(row.get(detail[0]) is not None for row in rows)]
    lines = [["agent", *(title for _, title, _, _ in shown)]]
    for row in rows:
        cells = [(row.get(name), scale, digits) for name, _, scale, digits in shown]
        lines.append([row["agent"], *("" if v is None else f"{v * scale:.{digits}f}" for v, scale, digits in cells)])
    return _table(lines)


def _bounds(bounds: dict[str, float] | None) -> str:
    """Returns the sentence on success without localising by LiDAR."""
    if bounds is None:
        return ""
    command, odometry, fused = (f"{100 * bounds[name]:.1f} %" for name in ("command", "odometry", "fused"))
    return (
        "Who steers by LiDAR but does not localise by it can expect, by theory, "
        f"{command} from commands, {odometry} from odometry, {fused} from both."
    )


def _inputs(rows: list[dict[str, Any]]) -> str:
    """Returns the inputs that an agent declares; tasks where they differ from the first task's are named."""
    inputs = {_short(row["task"]): _declared(row) for row in rows}
    usual = next(iter(inputs.values()))
    others = [f"{task}: {text}" for task, text in inputs.items() if text != usual]
    return "; ".join([usual, *others])


def _declared(row: dict[str, Any]) -> str:
    if row["privileged"]:
        return "truth"
    names = [name for name, key in (("LiDAR", "uses_lidar"), ("map", "uses_map")) if row[key]]
    return ", ".join(names) or "nothing"


def _success(row: dict[str, Any] | None) -> str:
    if row is None:
        return ""
    return f"{100 * row['success']:.1f} ({100 * row['success_low']:.0f}-{100 * row['success_high']:.0f})"


def _short(task: str) -> str:
    return task.removeprefix("Subterra/").removesuffix("-v1")


def _table(lines: list[list[str]]) -> str:
    rows = [f"| {' | '.join(line)} |" for line in lines]
    return "\n".join([rows[0], "|" + "---|" * len(lines[0]), *rows[1:]])


_COLUMNS = 4


def read_markdown(path: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Reads the table of success of the first tunnel of a `leaderboard.md`, for `as_png`.

    Raises:
        BenchmarkError: The file cannot be read, or holds no such table.
    """
    try:
        text = path.read_text()
    except OSError as error:
        raise BenchmarkError(f"{path}: cannot be read ({error.strerror})") from error
    episodes, world = re.search(r"^(\d+) episodes a task", text, re.M), re.search(r"^## (.+)$", text, re.M)
    table = re.search(r"^\| agent \| sees \|.*\n\|[-|]+\|\n((?:\|.*\n)+)", text, re.M)
    if episodes is None or world is None or table is None:
        raise BenchmarkError(f"{path}: holds no leaderboard")
    tasks = [cell.strip() for cell in table[0].splitlines()[0].split("|")[3:-1]]
    rows = []
    for line in table[1].splitlines():
        agent, _, *cells = (cell.strip() for cell in line.split("|")[1:-1])
        for task, cell in zip(tasks, cells, strict=True):
            if numbers := re.fullmatch(r"([\d.]+) \((\d+)-(\d+)\)", cell):
                success, low, high = (float(number) / 100.0 for number in numbers.groups())
                row = {"task": f"Subterra/{task}-v1", "world": world[1], "agent": agent, "success": success}
                rows.append({**row, "success_low": low, "success_high": high})
    return rows, {"episodes": int(episodes[1])}


def figure_digest(rows: list[dict[str, Any]]) -> str:
    """Returns the SHA-256 of the numbers in a figure, rounded as in `leaderboard.md`, in any order."""
    cells = sorted(f"{row['world']} {row['agent']} {_short(row['task'])} {_success(row)}" for row in rows)
    return hashlib.sha256("\n".join(cells).encode()).hexdigest()


def draw(rows: list[dict[str, Any]], facts: dict[str, Any]) -> Figure:
    """Draws one panel for each task, with agents down the side and a colour for each tunnel."""
    tasks, agents, worlds = (list(dict.fromkeys(row[key] for row in rows)) for key in ("task", "agent", "world"))
    n_columns = min(_COLUMNS, len(tasks))
    n_rows = -(-len(tasks) // n_columns)
    size = (2.0 + 3.0 * n_columns, 0.8 + n_rows * (0.7 + 0.24 * len(agents) * max(1, 0.7 * len(worlds))))
    figure, grid = plt.subplots(n_rows, n_columns, figsize=size, sharex=True, sharey=True, squeeze=False,
                                layout="constrained")  # fmt: skip
    colours = plt.get_cmap("tab10")
    height = 0.8 / len(worlds)
    for axes, task in zip(grid.flat, tasks, strict=False):
        for i, world in enumerate(worlds):
            mine = [row for row in rows if (row["task"], row["world"]) == (task, world)]
            place = np.array([agents.index(row["agent"]) for row in mine]) + height * (i - 0.5 * (len(worlds) - 1))
            success, low, high = (100.0 * np.array([row[k] for row in mine]) for k in
                                  ("success", "success_low", "success_high"))  # fmt: skip
            spread = np.maximum([success - low, high - success], 0.0)
            axes.barh(place, success, height, color=colours(i), alpha=0.75, label=world)
            axes.errorbar(success, place, xerr=spread, fmt="none", ecolor="0.2", elinewidth=1.0, capsize=2.0)
        axes.set_title(task.removeprefix("Subterra/"), fontsize=9)
        axes.set_yticks(range(len(agents)), [re.sub(r"[^:]*/", "", name) for name in agents], fontsize=8)
        axes.set_xlim(0.0, 103.0)
        axes.tick_params(labelbottom=True, labelsize=8)
        axes.grid(axis="x", alpha=0.3)
    grid[0, 0].invert_yaxis()
    for axes in list(grid.flat)[len(tasks) :]:
        axes.axis("off")
    if len(worlds) > 1:
        figure.legend(
            *grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(worlds), fontsize=8
        )
    title = "" if len(worlds) > 1 else f"{worlds[0]}; "
    figure.suptitle(f"{title}{facts['episodes']} episodes a task; success, %, with 95 % intervals", fontsize=10)
    return figure


def as_png(rows: list[dict[str, Any]], facts: dict[str, Any]) -> bytes:
    """Returns the figure as a PNG file; its text entry `Source` is the digest of the numbers drawn."""
    return png_bytes(draw(rows, facts), dpi=130, metadata={"Source": figure_digest(rows)})
