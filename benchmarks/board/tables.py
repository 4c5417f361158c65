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


def percent(share: float | None) -> str:
    """Return a share in whole per cent; a dash for None."""
    return "-" if share is None else f"{100 * share:.0f}"


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


# Marker, colour and name of a group; agents without a line in the roster are `other`.
_LOOKS: dict[Group, tuple[str, str, str]] = {
    "blind": ("v", "#7a7a7a", "never looks at the walls to localise"),
    "written": ("o", "#c77700", "written, no map"),
    "learnt": ("D", "#1b4965", "learnt, no map"),
    "reward": ("*", "#c1121f", "learnt by reward alone, no map"),
    "map": ("s", "#1f8a7d", "has the map"),
    "other": ("P", "#8367c7", "other agents"),
}
_WORDS = (
    "Success over the {kinds} with its 95 % interval; small dots: one kind each. Grey: from the floor, the most that"
    " theory allows without a look at the walls,\nto the ceiling, a filter that has the map and every size. An agent"
    " below the floor loses way at turns and boxes or trusts a false match; one above the ceiling is so by chance.\n"
    "{leaks}"
)


def draw(cells: Cells, split: str = SPLIT) -> Figure:
    """Draw one panel a task, of the kinds of one split; of all columns where nobody drove in it."""
    keys = [key for key in keys_of(cells) if key[0] == split] or keys_of(cells)
    cells = [cell for cell in cells if summarise(cell, keys) is not None]
    settings = settings_of(cells)
    n_columns = min(3, len(settings))
    shape = (-(-len(settings) // n_columns), n_columns)
    size = (1.0 + 4.0 * max(2, n_columns), 1.6 + 2.3 * shape[0])
    figure, grid = plt.subplots(*shape, figsize=size, squeeze=False, layout="constrained", sharex=True)
    for axes, setting in zip(grid.flat, settings, strict=False):
        _panel(axes, setting.words, [cell for cell in cells if setting_of(cell) == setting], keys)
    for axes in list(grid.flat)[len(settings) :]:
        axes.axis("off")
    for axes in grid[-1]:
        axes.set_xlabel("success, %")
    found = (zip(*axes.get_legend_handles_labels(), strict=True) for axes in grid.flat)
    handles = {name: handle for pairs in found for handle, name in pairs}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6, fontsize=9)
    leaks = "; ".join(find_leaks(cells)) or "No figure is beyond a bound by four standard errors."
    kinds = f"{len(keys)} kinds of {split}" if keys[0][0] == split else f"{len(keys)} columns"
    figure.suptitle(_WORDS.format(kinds=kinds, leaks=leaks), fontsize=9)
    return figure


def _panel(axes: Axes, title: str, cells: Cells, keys: list[Key]) -> None:
    shown = [cell for cell in cells if entry_of(cell["agent"]).group not in ("ceiling", "truth")]
    for row, cell in enumerate(shown):
        marker, colour, name = _LOOKS[entry_of(cell["agent"]).group]
        whole, each = summarise(cell, keys), [summarise(cell, (key,)) for key in keys]
        assert whole is not None
        parts = [100.0 * one.success for one in each if one is not None]
        axes.plot(parts, [row] * len(parts), ".", ms=5, color=colour, alpha=0.35, mew=0)
        ends = [[100.0 * max(whole.success - whole.low, 0.0)], [100.0 * max(whole.high - whole.success, 0.0)]]
        axes.errorbar(100.0 * whole.success, row, xerr=ends, fmt=marker, ms=7, lw=1.5, color=colour, mec="white",
                      mew=0.5, label=name)  # fmt: skip
    floor = next((one.floor for cell in cells if (one := summarise(cell, keys)) is not None), None) or 0.0
    top = next((one for cell in cells if cell["agent"] == CEILING and (one := summarise(cell, keys))), None)
    ceiling = 1.0 if top is None else top.success
    axes.axvspan(100.0 * floor, 100.0 * ceiling, color="#e9e9e9", zorder=0)
    for place, name in ((floor, "floor"), (ceiling, "ceiling")):
        axes.axvline(100.0 * place, color="#555555", lw=1.0, ls="--", zorder=1)
        axes.text(100.0 * place, -0.62, f"{name} {100 * place:.0f}", ha="center", va="bottom", fontsize=7.5)
    axes.set_title(title, fontsize=11, pad=12)
    axes.set(xlim=(-3.0, 104.0), ylim=(len(shown) - 0.4, -0.6))
    axes.set_yticks(range(len(shown)), [cell["agent"] for cell in shown], fontsize=8.5)
    for label, cell in zip(axes.get_yticklabels(), shown, strict=True):
        label.set_color(_LOOKS[entry_of(cell["agent"]).group][1])
    axes.grid(axis="x", alpha=0.3)
