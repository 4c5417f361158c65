"""The board's figures as records: each agent on each task, over all kinds of a split, and the best of each group."""

from typing import Any

from benchmarks.board.cells import Cells, Score, keys_of, over_split, setting_of
from benchmarks.board.columns import OWN, Setting
from benchmarks.board.tables import HEADINGS, SPLIT, screen
from benchmarks.records import Record, of_facts


def records_of(cells: Cells) -> list[Record]:
    """Return the records of cells: `board/TASK/SPLIT/AGENT`, and `board/TASK/best/HEADING` of the table of a screen."""
    found = []
    for cell in cells:
        setting = setting_of(cell)
        for split in dict.fromkeys(split for split, _ in keys_of(cells) if split != OWN):
            if (score := over_split(cells, setting, cell["agent"], split)) is not None:
                found.append(_record(f"board/{slug(setting)}/{split}/{_plain(cell['agent'])}", score, cell, split))
    for row in screen(cells):
        setting = row["setting"]
        for heading in HEADINGS[1:]:
            if row[heading] is not None:
                agent, score = row[heading]
                cell = next(c for c in cells if setting_of(c) == setting and c["agent"] == agent)
                found.append(_record(f"board/{slug(setting)}/best/{heading.replace(' ', '-')}", score, cell, SPLIT))
        if row["floor"] is not None:
            cell = next(c for c in cells if setting_of(c) == setting)
            whole = Score(row["floor"], 0.0, 0.0, 0.0, None, None, 0)
            found.append(_record(f"board/{slug(setting)}/best/floor", whole, cell, SPLIT))
    return found


def slug(setting: Setting) -> str:
    """Return the name of a task in ids."""
    return _plain(setting.task) + ("+hidden" if setting.hidden_start else "")


def _plain(name: str) -> str:
    """Return a name without what an id cannot hold."""
    return name.replace("/", "_").replace(":", "-")


def _record(id: str, score: Score, cell: dict[str, Any], split: str) -> Record:
    share = lambda value: round(100.0 * value, 1)  # noqa: E731
    start = "hidden" if cell["hidden_start"] else "given"
    return Record(
        id=id,
        value=share(score.success),
        unit="%",
        interval=(share(score.low), share(score.high)) if score.n else None,
        n=score.n or None,
        split=split,
        seed=None,
        command=f"benchmarks.board --tasks {cell['task']} --start {start} --agents {cell['agent']} --out out/board",
        tolerance=share(score.high - score.low) / 2.0 if score.n else 0.1,
        **of_facts(cell["facts"]),
    )
