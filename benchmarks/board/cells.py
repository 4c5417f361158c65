"""Cells of the board: read, put in order, summed up with their intervals, and compared with floor and ceiling."""

import dataclasses
import functools
import json
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.board.columns import Setting, tunnels_in
from benchmarks.board.roster import ROSTER, entry_of
from benchmarks.command import BenchmarkError
from subterra_jax.evaluation.floor import is_above
from subterra_jax.evaluation.records import grouped, interval

SCHEMA = "subterra.board/1"
CEILING = "ceiling"
_ORDER = ("StopAt", "Return", "Obstructed", "Faulted", "Relocalise")
_AGENTS = tuple(entry.name for entry in ROSTER)


@dataclasses.dataclass(frozen=True)
class Score:
    """Success of an agent in one column, or over several."""

    success: float  # Fraction of the episodes, 0 to 1
    low: float  # Lower end of its 95 % interval, by a bootstrap of seeds within tunnels
    high: float  # Upper end
    contact: float  # Fraction of the episodes that end at a wall or a box
    median_error: float | None  # Median distance from the goal at the stop, m; None where nobody stopped
    floor: float | None  # Success that theory allows without a look at the walls; None where it is not known
    n: int  # Episodes


Key = tuple[str, str]  # split, kind
Cell = dict[str, Any]
Cells = Sequence[Cell]


def read_cells(source: Path, conditions: Collection[str] | None = None) -> list[Cell]:
    """Read the cells that were driven under some conditions, in the order of tasks and agents.

    Args:
        source: Folder with a file for each cell, or a file with a line for each.
        conditions: Digests of the conditions: those of all splits, and of a few of them; None takes all.

    Raises:
        BenchmarkError: There is none, or a line is no cell.
    """
    try:
        files = [source] if source.is_file() else sorted(source.glob("*.json"))
        cells = [json.loads(line) for file in files for line in file.read_text().splitlines()]
        cells = [cell for cell in cells if cell.get("schema") == SCHEMA]
        cells = [cell for cell in cells if conditions is None or cell["conditions"] in conditions]
    except (ValueError, AttributeError, KeyError) as error:
        raise BenchmarkError(f"{source}: holds something that is no cell of the board") from error
    if not cells:
        raise BenchmarkError(f"{source}: holds no cell of these tunnels, episodes and constants")
    return sorted(cells, key=_place)


def _place(cell: Cell) -> tuple[Any, ...]:
    place = lambda names, name: names.index(name) if name in names else len(names)  # noqa: E731
    return cell["hidden_start"], place(_ORDER, cell["task"]), cell["task"], place(_AGENTS, cell["agent"]), cell["agent"]


def setting_of(cell: Cell) -> Setting:
    """Return what was driven."""
    return Setting(cell["task"], cell["hidden_start"], cell.get("texture", 0.0))


def settings_of(cells: Cells) -> list[Setting]:
    """Return all that was driven, in order."""
    return list(dict.fromkeys(setting_of(cell) for cell in cells))


def keys_of(cells: Cells) -> list[Key]:
    """Return split and kind of all columns, those of the cell with most of them first."""
    widest = sorted(cells, key=lambda cell: -len(cell["columns"]))
    return list(dict.fromkeys((column["split"], column["kind"]) for cell in widest for column in cell["columns"]))


def summarise(cell: Cell, chosen: Collection[Key]) -> Score | None:
    """Sum up columns of one split, each counted alike.

    The kinds of a split share their seeds, and who never looks at the walls does the same in each of them: an interval
    over kinds is of the seeds, not of all episodes.

    Args:
        cell: The cell.
        chosen: Split and kind of the columns.

    Returns:
        The score; None where the cell has none of these columns.
    """
    size = len(cell["success"]) // len(cell["columns"])
    rows, group, floors, first = [], np.zeros(size, int), [], 0
    for place, column in enumerate(cell["columns"]):
        tunnels = tunnels_in(column["split"], cell["tunnels"])
        if (column["split"], column["kind"]) in chosen:
            rows.append(np.arange(place * size, (place + 1) * size))
            group = np.arange(size) % tunnels
            floors += [] if cell["floor"] is None else [np.mean(cell["floor"][first : first + tunnels])]
        first += tunnels
    if not rows:
        return None
    row = np.concatenate(rows)
    success, contact = (np.array(cell[name], float)[row] for name in ("success", "contact"))
    error = np.array([np.nan if e is None else e for e in cell["goal_error"]], float)[row]
    low, high = _ends(success.reshape(len(rows), size).mean(axis=0).tobytes(), group.tobytes())
    stopped = np.abs(error[~np.isnan(error) & (contact == 0.0)])
    return Score(
        success=float(success.mean()),
        low=low,
        high=high,
        contact=float(contact.mean()),
        median_error=float(np.median(stopped)) if len(stopped) else None,
        floor=float(np.mean(floors)) if floors else None,
        n=len(row),
    )


@functools.cache  # tables, picture, leaks and records ask for the same ones
def _ends(success: bytes, group: bytes) -> tuple[float, float]:
    """Return the 95 % interval of a mean within groups, given as the bytes of float64 and int64 arrays."""
    rows = grouped(np.frombuffer(success), np.frombuffer(group, np.int64))
    return interval(rows, lambda drawn: drawn.mean(axis=(-2, -1)))


def scores_of(cells: Cells, setting: Setting) -> dict[str, dict[Key, Score]]:
    """Return the scores of each agent of a task by split and kind, of all splits that it was driven in."""
    found: dict[str, dict[Key, Score]] = {}
    for cell in cells:
        if setting_of(cell) == setting:
            for column in cell["columns"]:
                key = (column["split"], column["kind"])
                score = summarise(cell, (key,))
                assert score is not None
                found.setdefault(cell["agent"], {})[key] = score
    return found


def over_split(cells: Cells, setting: Setting, agent: str, split: str) -> Score | None:
    """Return the score of an agent over all kinds of a split; None where it was not driven in all of them."""
    needed = {key for key in keys_of(cells) if key[0] == split}
    for cell in cells:
        there = {(column["split"], column["kind"]) for column in cell["columns"]}
        if setting_of(cell) == setting and cell["agent"] == agent and needed <= there:
            return summarise(cell, needed)
    return None


def find_leaks(cells: Cells) -> list[str]:
    """Name the figures beyond a bound: a blind agent above the floor, or any agent above the ceiling.

    A figure is beyond where the difference is more than four standard errors of the two: a table has some hundred.
    """
    found = []
    for setting in settings_of(cells):
        scores = scores_of(cells, setting)
        for agent, of_agent in scores.items():
            if entry_of(agent).group == "truth":
                continue
            for (split, kind), score in of_agent.items():
                where = f"{agent}, {setting.words}, {kind} of {split}: {100 * score.success:.0f} % is above"
                floor = score.floor if entry_of(agent).group == "blind" else None
                if floor is not None and is_above(score.success, floor, score.n, 0):
                    found.append(f"{where} the floor, {100 * floor:.0f} %")
                top = scores.get(CEILING, {}).get((split, kind))
                if top is not None and is_above(score.success, top.success, score.n, top.n):
                    found.append(f"{where} the ceiling, {100 * top.success:.0f} %")
    return found
