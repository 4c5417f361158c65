"""Every agent on every task, by kind of lining and split, between floor and ceiling.

`python -m benchmarks.board --tasks StopAt Return --out out/board`

Each task and agent is one file under `--out`/cells; a cell that is there is not driven again. `--report-only` writes
tables and picture of the cells that are there, or of those in `--cells`: `benchmarks/board/cells.jsonl` is on record.
"""

import json
import sys

from benchmarks.board import tables
from benchmarks.board.cells import Cell, Cells, Score, keys_of, over_split, read_cells, setting_of
from benchmarks.board.columns import OWN, Setting
from benchmarks.board.drive import (
    BoardConfig,
    check,
    choose_by_rule,
    conditions_of_parts,
    drive,
    is_there,
    jobs_of,
)
from benchmarks.command import run_main
from benchmarks.records import Record, of_facts, write_records
from benchmarks.results import png_bytes, write_file
from subterra_jax.host.files import require_folder
from subterra_jax.host.loading import load_file


def run(config: BoardConfig) -> None:
    """Drives the agents whose cells are missing, and writes tables, picture and records.

    Raises:
        SubterraError: A task, split or agent is unknown, or the folder cannot be written.
    """
    for file in config.load:
        load_file(file)
    check(config)
    jobs = jobs_of(config)
    require_folder(config.out)
    missing = [job for job in jobs if not is_there(config, job)]
    if missing and not config.report_only:
        drive(config, missing)
    cells = read_cells(config.cells or config.out / "cells", conditions_of_parts(config))
    write_file(config.out / "cells.jsonl", "".join(json.dumps(cell) + "\n" for cell in cells).encode())
    write_file(config.out / "board.md", tables.as_markdown(cells).encode())
    write_file(config.out / "board.png", png_bytes(tables.draw(cells), dpi=110))
    write_records(config.out / "records.json", records_of(cells))
    if table := tables.screen_markdown(cells):
        print(table)
    print(config.out / "board.md")


def records_of(cells: Cells) -> list[Record]:
    """Return the records of cells: `board/TASK/SPLIT/AGENT`, and `board/TASK/best/HEADING` of the table of a screen."""
    found = []
    for cell in cells:
        setting = setting_of(cell)
        for split in dict.fromkeys(split for split, _ in keys_of(cells) if split != OWN):
            if (score := over_split(cells, setting, cell["agent"], split)) is not None:
                found.append(_record(f"board/{slug(setting)}/{split}/{_plain(cell['agent'])}", score, cell, split))
    for row in tables.screen(cells):
        setting = row["setting"]
        for heading in tables.HEADINGS[1:]:
            if row[heading] is not None:
                agent, score = row[heading]
                cell = next(c for c in cells if setting_of(c) == setting and c["agent"] == agent)
                found.append(
                    _record(f"board/{slug(setting)}/best/{heading.replace(' ', '-')}", score, cell, tables.SPLIT)
                )
        if row["floor"] is not None:
            cell = next(c for c in cells if setting_of(c) == setting)
            whole = Score(row["floor"], 0.0, 0.0, 0.0, None, None, 0)
            found.append(_record(f"board/{slug(setting)}/best/floor", whole, cell, tables.SPLIT))
    return found


def slug(setting: Setting) -> str:
    """Return the name of a task in ids."""
    texture = f"+texture-{setting.texture:g}" if setting.texture else ""
    return _plain(setting.task) + ("+hidden" if setting.hidden_start else "") + texture


def _plain(name: str) -> str:
    """Return a name without what an id cannot hold."""
    return name.replace("/", "_").replace(":", "-")


def _record(id: str, score: Score, cell: Cell, split: str) -> Record:
    fraction = lambda value: round(100.0 * value, 1)  # noqa: E731
    start = "hidden" if cell["hidden_start"] else "given"
    words = f"--agents {cell['agent']} " + (f"--texture {cell['texture']:g} " if cell.get("texture") else "")
    return Record(
        id=id,
        value=fraction(score.success),
        unit="%",
        interval=(fraction(score.low), fraction(score.high)) if score.n else None,
        n=score.n or None,
        split=split,
        seed=None,
        command=f"benchmarks.board --tasks {cell['task']} --start {start} {words}--out out/board",
        tolerance=fraction(score.high - score.low) / 2.0 if score.n else 0.1,
        **of_facts(cell["facts"]),
    )


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake, 130 for an interrupt, after which a run can go on."""
    choose_by_rule()
    again = "interrupted; the same command goes on"
    return run_main("board", BoardConfig, run, description=__doc__, words=words, interrupted=again)


if __name__ == "__main__":
    sys.exit(main())
