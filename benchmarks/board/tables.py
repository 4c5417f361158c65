"""Tables of the board, one that fits a screen, then one for each task and split by kind; and its picture."""

from collections.abc import Callable, Iterator
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.board.cells import (
    CEILING,
    Cells,
    Key,
    Score,
    find_leaks,
    keys_of,
    over_split,
    scores_of,
    setting_of,
    settings_of,
    summarise,
)
from benchmarks.board.columns import OWN, Setting
from benchmarks.board.roster import Group, entry_of
from benchmarks.results import markdown_table

SPLIT = "test-unseen"  # of the table that fits a screen
CHOICE = "val"  # where the best of a group is chosen
HEADINGS = ("floor", "best written", "learnt", "learnt by reward alone", "with map", "ceiling")
GROUPS: dict[str, tuple[Group, ...]] = {
    "best written": ("blind", "written"),
    "learnt": ("learnt",),
    "learnt by reward alone": ("reward",),
    "with map": ("map",),
}


def best_of(cells: Cells, setting: Setting, groups: tuple[Group, ...], split: str) -> str | None:
    """Return the best agent of some groups over all kinds of a split: chosen on `val`, or there where nobody drove it.

    Returns:
        Its name; None where nobody of these groups drove in all kinds of the split.
    """
    agents = {
        cell["agent"] for cell in cells if setting_of(cell) == setting and entry_of(cell["agent"]).group in groups
    }
    agents = {agent for agent in agents if over_split(cells, setting, agent, split) is not None}
    scores = {agent: over_split(cells, setting, agent, CHOICE) for agent in sorted(agents)}
    if not all(scores.values()):
        scores = {agent: over_split(cells, setting, agent, split) for agent in sorted(agents)}
    success = {agent: score.success for agent, score in scores.items() if score is not None}
    return max(success, key=success.__getitem__, default=None)


def screen(cells: Cells, split: str = SPLIT) -> list[dict[str, Any]]:
    """Return a row for each task: setting, floor, and by heading the agent and its score over all kinds of a split."""
    rows = []
    for setting in settings_of(cells):
        row: dict[str, Any] = {"setting": setting, "floor": None}
        for heading in HEADINGS[1:]:
            agent = CEILING if heading == CEILING else best_of(cells, setting, GROUPS[heading], split)
            score = None if agent is None else over_split(cells, setting, agent, split)
            row[heading] = None if agent is None or score is None else (agent, score)
            if score is not None and score.floor is not None:
                row["floor"] = score.floor
        if any(row[heading] is not None for heading in HEADINGS[1:]):
            rows.append(row)
    return rows


def screen_markdown(cells: Cells, split: str = SPLIT) -> str:
    """Return the table that fits a screen; empty where nobody drove in all kinds of the split."""

    def named(found: tuple[str, Score] | None) -> str:
        if found is None:
            return "-"
        agent, score = found
        return f"**{percent(score.success)}** {_interval(score)}" + ("" if agent == CEILING else f" `{agent}`")

    rows = [(row["setting"].words, percent(row["floor"]), *(named(row[heading]) for heading in HEADINGS[1:]))
            for row in screen(cells, split)]  # fmt: skip
    return markdown_table(("task", *HEADINGS), rows) if rows else ""


def percent(fraction: float | None) -> str:
    """Return a fraction in whole per cent; a dash for None."""
    return "-" if fraction is None else f"{100 * fraction:.0f}"


def _interval(score: Score) -> str:
    return f"({percent(score.low)}-{percent(score.high)})"


def as_markdown(cells: Cells) -> str:
    """Return the table that fits a screen, then one table for each split and task by kind."""
    facts = cells[0]["facts"]
    devices = ", ".join(dict.fromkeys(cell["facts"]["device"] for cell in cells))
    parts = [
        f"Constants `{facts['constants_sha256'][:12]}`; {cells[0]['tunnels']} tunnels and "
        f"{len(cells[0]['success']) // len(cells[0]['columns'])} episodes of each kind and split; {devices}.\n"
        f"Beyond a bound: {'; '.join(find_leaks(cells)) or 'nobody'}.\n"
    ]
    if table := screen_markdown(cells):
        parts += [
            f"## All kinds of {SPLIT}\n\nSuccess in %, the mean over all kinds, with its 95 % interval. The best of a "
            f"group is the one that was best on `{CHOICE}`.\n",
            table,
        ]
    for split in dict.fromkeys(split for split, _ in keys_of(cells)):
        parts.append(
            f"## {'Further tunnels' if split == OWN else split} by kind\n\nSuccess in %, its 95 % interval, median "
            "distance from the goal at the stop in m, contacts in %.\n"
        )
        parts += [f"### {task}\n\n{table}" for task, table in _tables_by_kind(cells, split, _detailed)]
    return "\n".join(parts)


def kinds_markdown(cells: Cells, split: str) -> str:
    """Return one table for each task of a split: success in % alone, by kind; without the two agents that bound all."""
    shown = [cell for cell in cells if cell["agent"] not in ("random", "oracle")]
    tables = _tables_by_kind(shown, split, lambda score: percent(score.success))
    return "\n".join(f"| **{task}** |{table.removeprefix('| agent |')}" for task, table in tables)


def _tables_by_kind(cells: Cells, split: str, show: Callable[[Score], str]) -> Iterator[tuple[str, str]]:
    """Yield task and table of each task that was driven in a split: the floor, then all agents."""
    for setting in settings_of(cells):
        scores = scores_of(cells, setting)
        kinds = [kind for at, kind in keys_of(cells) if at == split]
        rows = {agent: [some.get((split, kind)) for kind in kinds] for agent, some in scores.items()}
        rows = {agent: row for agent, row in rows.items() if any(row)}
        columns = [
            [score.floor for score in column if score is not None] for column in zip(*rows.values(), strict=True)
        ]
        floors = [next(iter(column), None) for column in columns]
        lines = [["*floor*", *map(percent, floors)]] if any(bound is not None for bound in floors) else []
        for agent, row in rows.items():
            name = f"*{agent}*" if entry_of(agent).group in ("ceiling", "truth") else agent
            lines.append([name, *("-" if score is None else show(score) for score in row)])
        if rows:
            yield setting.words, markdown_table(("agent", *kinds), lines)


def _detailed(score: Score) -> str:
    error = "-" if score.median_error is None else f"{score.median_error:.2f}"
    contact = f", contact {percent(score.contact)}" if score.contact else ""
    return f"{percent(score.success)} {_interval(score)}, {error}{contact}"


_OTHERS = "other agents"  # those without a line in the roster
_LOOKS = {
    "best written": ("o", "#c77700"),
    "learnt": ("D", "#1b4965"),
    "learnt by reward alone": ("*", "#c1121f"),
    "with map": ("s", "#1f8a7d"),
    _OTHERS: ("P", "#8367c7"),
}
_WORDS = "Success, %, the mean of {kinds}; bars: 95 % interval; grey: from floor to ceiling\n{leaks}"
_LANE = 0.24  # height of an agent's line, inches


def draw(cells: Cells, split: str = SPLIT) -> Figure:
    """Draw the best of each group by task, between floor and ceiling, over all columns where nobody drove in a split.

    Agents without a line in the roster all have a line.
    """
    keys = [key for key in keys_of(cells) if key[0] == split] or keys_of(cells)
    blocks = [(setting, _lanes(cells, setting, keys, split)) for setting in settings_of(cells)]
    blocks = [(setting, lanes) for setting, lanes in blocks if lanes]
    height = _LANE * sum(len(lanes) + 1.3 for _, lanes in blocks)
    figure, axes = plt.subplots(figsize=(8.0, 1.5 + height), layout="constrained")
    first, ticks = 0.0, []
    for setting, lanes in blocks:
        _bounds(axes, [cell for cell in cells if setting_of(cell) == setting], keys, first, first + len(lanes))
        for row, lane in enumerate(lanes):
            _lane(axes, first + row + 0.5, *lane)
        ticks.append(first + len(lanes) / 2)
        first += len(lanes) + 1.3
    axes.set(xlim=(-2.0, 104.0), ylim=(first - 1.0, -1.2), xlabel="success, %")
    axes.set_yticks(ticks, [setting.words.replace(", ", "\n") for setting, _ in blocks], fontsize=10, weight="bold")
    axes.tick_params(axis="y", length=0)
    axes.spines[["left", "right", "top"]].set_visible(False)
    named = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=6, fontsize=9, frameon=False)
    leaks = f"Beyond a bound: {'; '.join(found)}" if (found := find_leaks(cells)) else ""
    kinds = f"{len(keys)} kinds of {split}" if keys[0][0] == split else f"{len(keys)} columns"
    figure.suptitle(_WORDS.format(kinds=kinds, leaks=leaks).strip(), fontsize=9)
    return figure


def _lanes(cells: Cells, setting: Setting, keys: list[Key], split: str) -> list[tuple[str, str, Score]]:
    """Return a line for each group of a task: heading, best agent and its score."""
    mine = [cell for cell in cells if setting_of(cell) == setting]
    scores = {cell["agent"]: score for cell in mine if (score := summarise(cell, keys)) is not None}
    lanes = []
    for heading, groups in GROUPS.items():
        of_group = [agent for agent in scores if entry_of(agent).group in groups]
        if of_group:
            best = best_of(cells, setting, groups, split) or max(of_group, key=lambda agent: scores[agent].success)
            lanes.append((heading, best, scores[best]))
    return lanes + [(_OTHERS, agent, score) for agent, score in scores.items() if entry_of(agent).group == "other"]


def _bounds(axes: Axes, cells: Cells, keys: list[Key], top: float, bottom: float) -> None:
    """Draw floor and ceiling of a task, and the band between them."""
    scores = {cell["agent"]: score for cell in cells if (score := summarise(cell, keys)) is not None}
    floor = next((score.floor for score in scores.values()), None) or 0.0
    ceiling = scores[CEILING].success if CEILING in scores else 1.0
    axes.fill_betweenx([top, bottom], 100 * floor, 100 * ceiling, color="#e9e9e9", lw=0.0, zorder=0)
    for place, name in ((floor, "floor"), (ceiling, "ceiling")):
        axes.vlines(100 * place, top, bottom, color="black", lw=2.0, zorder=1)
        axes.text(100 * place, top - 0.1, f"{name} {percent(place)}", ha="center", va="bottom", fontsize=7.5)


def _lane(axes: Axes, row: float, heading: str, agent: str, score: Score) -> None:
    """Draw an agent with its interval, figure and name, which stand where there is room."""
    marker, colour = _LOOKS[heading]
    low, success, high = (100 * value for value in (score.low, score.success, score.high))
    ends = [[max(success - low, 0.0)], [max(high - success, 0.0)]]
    axes.errorbar(success, row, xerr=ends, fmt=marker, ms=8, lw=2.0, color=colour, label=heading, zorder=3)
    place, side = (max(high, success) + 1.6, "left") if success < 60.0 else (min(low, success) - 1.6, "right")
    behind = {"fc": "white", "alpha": 0.8, "lw": 0.0, "pad": 0.8}
    axes.text(place, row, f"{percent(score.success)}  {agent}", color=colour, fontsize=8.5, ha=side, va="center",
              bbox=behind)  # fmt: skip
