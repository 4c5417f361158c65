"""Tables of the board: one that fits a screen, and behind it one for each task and split by kind."""

from collections.abc import Sequence
from typing import Any

from benchmarks.board.cells import (
    CEILING,
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

SPLIT = "test-unseen"  # of the table that fits a screen
CHOICE = "val"  # where the best of a group is chosen
HEADINGS = ("floor", "best written", "learnt", "learnt by reward alone", "with map", "ceiling")
GROUPS: dict[str, tuple[Group, ...]] = {
    "best written": ("blind", "written"),
    "learnt": ("learnt", "reward"),
    "learnt by reward alone": ("reward",),
    "with map": ("map",),
}


def best_of(cells: Sequence[dict[str, Any]], setting: Setting, groups: tuple[Group, ...], split: str) -> str | None:
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


def screen(cells: Sequence[dict[str, Any]], split: str = SPLIT) -> list[dict[str, Any]]:
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


def screen_markdown(cells: Sequence[dict[str, Any]], split: str = SPLIT) -> str:
    """Return the table that fits a screen; empty where nobody drove in all kinds of the split."""
    rows = screen(cells, split)
    if not rows:
        return ""
    lines = ["| task | " + " | ".join(HEADINGS) + " |", "|---|" + "---|" * len(HEADINGS)]
    for row in rows:
        floor = "-" if row["floor"] is None else f"{100 * row['floor']:.0f}"
        lines.append(f"| {row['setting'].words} | {floor} | " + " | ".join(_named(row[h]) for h in HEADINGS[1:]) + " |")
    return "\n".join(lines) + "\n"


def _named(found: tuple[str, Score] | None) -> str:
    """Return success with its interval, and whose it is."""
    if found is None:
        return "-"
    agent, score = found
    name = "" if agent == CEILING else f" `{agent}`"
    return f"**{100 * score.success:.0f}** ({100 * score.low:.0f}-{100 * score.high:.0f}){name}"


def as_markdown(cells: Sequence[dict[str, Any]]) -> str:
    """Return the table that fits a screen, then one table for each split and task by kind."""
    leaks = find_leaks(cells)
    facts = cells[0]["facts"]
    devices = ", ".join(dict.fromkeys(cell["facts"]["device"] for cell in cells))
    lines = [
        f"Constants `{facts['constants_sha256'][:12]}`; {cells[0]['tunnels']} tunnels and "
        f"{len(cells[0]['success']) // len(cells[0]['columns'])} episodes of each kind and split; {devices}.",
        "Beyond a bound: " + ("; ".join(leaks) if leaks else "nobody") + ".",
    ]
    if table := screen_markdown(cells):
        lines += ["", f"## All kinds of {SPLIT}", "", *_screen_words(), "", table.rstrip()]
    for split in dict.fromkeys(split for split, _ in keys_of(cells)):
        lines += ["", f"## {'Further tunnels' if split == OWN else split} by kind", "", *_kind_words()]
        for setting in settings_of(cells):
            lines += _by_kind(cells, setting, split)
    return "\n".join(lines) + "\n"


def _screen_words() -> list[str]:
    return [
        "Success in %, the mean over all kinds, with its 95 % interval. The best of a group is the one that was best",
        f"on `{CHOICE}`.",
    ]


def _kind_words() -> list[str]:
    return ["Success in %, its 95 % interval, median distance from the goal at the stop in m, contacts in %."]


def _by_kind(cells: Sequence[dict[str, Any]], setting: Setting, split: str) -> list[str]:
    """Return the table of a task and a split, with all its agents; nothing where nobody drove there."""
    scores = {
        agent: {kind: score for (at, kind), score in some.items() if at == split}
        for agent, some in scores_of(cells, setting).items()
    }
    scores = {agent: some for agent, some in scores.items() if some}
    if not scores:
        return []
    kinds = list(dict.fromkeys(kind for some in scores.values() for kind in some))
    lines = [
        "",
        f"### {setting.words}",
        "",
        f"| agent | tuned on | {' | '.join(kinds)} |",
        "|---|---|" + "---|" * len(kinds),
    ]
    floors = [next((s[kind].floor for s in scores.values() if kind in s), None) for kind in kinds]
    if any(bound is not None for bound in floors):
        shown = " | ".join("-" if bound is None else f"{100 * bound:.0f}" for bound in floors)
        lines.append(f"| floor, in theory | | {shown} |")
    for agent, some in scores.items():
        lines.append(f"| {agent} | {entry_of(agent).tuned} | " + " | ".join(_cell(some.get(k)) for k in kinds) + " |")
    return lines


def kinds_markdown(cells: Sequence[dict[str, Any]], split: str) -> str:
    """Return one table for each task of a split: success in % alone, by kind."""
    lines: list[str] = []
    for setting in settings_of(cells):
        scores = scores_of(cells, setting)
        kinds = [kind for at, kind in keys_of(cells) if at == split]
        rows = {agent: [some.get((split, kind)) for kind in kinds] for agent, some in scores.items()}
        rows = {agent: row for agent, row in rows.items() if any(row)}
        if not rows:
            continue
        lines += ["", f"| **{setting.words}** | {' | '.join(kinds)} |", "|---|" + "---|" * len(kinds)]
        floors = [
            next((score.floor for row in rows.values() if (score := row[i]) is not None), None)
            for i in range(len(kinds))
        ]
        if any(bound is not None for bound in floors):
            lines.append(f"| *floor* | {' | '.join('-' if b is None else f'{100 * b:.0f}' for b in floors)} |")
        for agent, row in rows.items():
            name = f"*{agent}*" if entry_of(agent).group in ("ceiling", "truth") else agent
            lines.append(f"| {name} | {' | '.join('-' if s is None else f'{100 * s.success:.0f}' for s in row)} |")
    return "\n".join(lines[1:]) + "\n"


def _cell(score: Score | None) -> str:
    if score is None:
        return "-"
    error = "-" if score.median_error is None else f"{score.median_error:.2f}"
    contact = f", contact {100 * score.contact:.0f}" if score.contact else ""
    return f"{100 * score.success:.0f} ({100 * score.low:.0f}-{100 * score.high:.0f}), {error}{contact}"
