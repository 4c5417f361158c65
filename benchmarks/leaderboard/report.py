"""The leaderboard as Markdown and JSON."""

import json
from typing import Any

from subterra_jax.evaluation.episodes import SHA256

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


def as_json(rows: list[dict[str, Any]], totals: list[dict[str, Any]], facts: dict[str, Any]) -> str:
    """Everything, for programs."""
    content = {"schema": SCHEMA, "evaluation_sha256": SHA256, **facts, "scores": rows, "totals": totals}
    return json.dumps(content, indent=1, allow_nan=False, default=str) + "\n"


def as_markdown(rows: list[dict[str, Any]], totals: list[dict[str, Any]], facts: dict[str, Any]) -> str:
    """The same for people."""
    parts = [
        "# Leaderboard",
        f"{facts['episodes']} episodes a task of the evaluation list with SHA-256 `{SHA256}`; {facts['device']}, "
        f"jax {facts['jax']}. Success in % with the 95 % interval of a bootstrap stratified over groups of episodes.",
    ]
    for world in dict.fromkeys(row["world"] for row in rows):
        here = [row for row in rows if row["world"] == world]
        parts += [f"## {world}", _overview(here), _totals([row for row in totals if row["world"] == world])]
        for task in dict.fromkeys(row["task"] for row in here):
            mine = [row for row in here if row["task"] == task]
            parts += [f"### {task}", _details(mine), _bounds(mine[0]["bounds"])]
    return "\n\n".join(part for part in parts if part) + "\n"


def _overview(rows: list[dict[str, Any]]) -> str:
    """Agents down, tasks across."""
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    lines = [["agent", "sees", *(_short(task) for task in tasks)]]
    for agent in dict.fromkeys(row["agent"] for row in rows):
        mine = {row["task"]: row for row in rows if row["agent"] == agent}
        lines.append([agent, _sees(next(iter(mine.values()))), *(_success(mine.get(task)) for task in tasks)])
    return _table(lines)


def _totals(rows: list[dict[str, Any]]) -> str:
    """Score over all tasks."""
    if not rows:
        return ""
    head = "Normalised score, 0 for dead reckoning and 1 for the oracle; inter-quartile mean over tasks and groups:"
    lines = [["agent", "score", "95 % interval", "tasks"]]
    for row in rows:
        interval = f"{row['low']:.3f} to {row['high']:.3f}"
        lines.append([row["agent"], f"{row['normalised_iqm']:.3f}", interval, str(row["tasks"])])
    return f"{head}\n\n{_table(lines)}"


def _details(rows: list[dict[str, Any]]) -> str:
    """Every quantity that anybody has in a task."""
    shown = [detail for detail in _DETAILS if any(row.get(detail[0]) is not None for row in rows)]
    lines = [["agent", *(title for _, title, _, _ in shown)]]
    for row in rows:
        cells = [(row.get(name), scale, digits) for name, _, scale, digits in shown]
        lines.append([row["agent"], *("" if v is None else f"{v * scale:.{digits}f}" for v, scale, digits in cells)])
    return _table(lines)


def _bounds(bounds: dict[str, float] | None) -> str:
    """What is possible without localising by LiDAR."""
    if bounds is None:
        return ""
    command, odometry, fused = (f"{100 * bounds[name]:.1f} %" for name in ("command", "odometry", "fused"))
    return (
        "Who steers by LiDAR but does not localise by it can expect, by theory, "
        f"{command} from commands, {odometry} from odometry, {fused} from both."
    )


def _sees(row: dict[str, Any]) -> str:
    if row["privileged"]:
        return "truth"
    seen = [name for name, key in (("LiDAR", "uses_lidar"), ("map", "uses_map")) if row[key]]
    return ", ".join(seen) or "nothing"


def _success(row: dict[str, Any] | None) -> str:
    if row is None:
        return ""
    return f"{100 * row['success']:.1f} ({100 * row['success_low']:.0f}-{100 * row['success_high']:.0f})"


def _short(task: str) -> str:
    return task.removeprefix("Subterra/").removesuffix("-v0")


def _table(lines: list[list[str]]) -> str:
    rows = [f"| {' | '.join(line)} |" for line in lines]
    return "\n".join([rows[0], "|" + "---|" * len(lines[0]), *rows[1:]])
