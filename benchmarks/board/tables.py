"""Tables of the board: one that fits a screen, and behind it one for each task and split by kind."""

from collections.abc import Callable, Iterator
from typing import Any

from benchmarks.board.cells import (
    CEILING,
    Cells,
    Score,
    find_leaks,
    keys_of,
    over_split,
    scores_of,
    setting_of,
    settings_of,
)
from benchmarks.board.columns import OWN, Setting
from benchmarks.board.roster import Group, entry_of
from benchmarks.results import markdown_table

SPLIT = "test-unseen"  # of the table that fits a screen
CHOICE = "val"  # where the best of a group is chosen
HEADINGS = ("floor", "best written", "learnt", "learnt by reward alone", "with map", "ceiling")
GROUPS: dict[str, tuple[Group, ...]] = {
    "best written": ("blind", "written"),
    "learnt": ("learnt", "reward"),
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
    chosen = {agent: over_split(cells, setting, agent, CHOICE) for agent in agents}
    if not all(chosen.values()):
        chosen = {agent: over_split(cells, setting, agent, split) for agent in agents}
    return max(sorted(agents), key=lambda agent: chosen[agent].success, default=None)  # type: ignore[union-attr]


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
    """Return one table for each task of a split: success in % alone, by kind."""
    tables = _tables_by_kind(cells, split, lambda score: percent(score.success))
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
