"""Every agent on every task, by kind of lining and split, between floor and ceiling.

`python -m benchmarks.board --tasks StopAt Return --out out/board`

Each task and agent is one file under `--out`/cells; a cell that is there is not driven again. `board.md` holds the
tables, `board.png` the picture, `cells.jsonl` all cells. `--report-only` writes them of the cells that are there, or of
those in a file `--cells`: `benchmarks/board/cells.jsonl` holds those on record.
"""

import json
import sys

from benchmarks.board import picture, tables
from benchmarks.board.cells import read_cells
from benchmarks.board.drive import BoardConfig, check, choose_by_rule, conditions_of_parts, drive, is_there, jobs_of
from benchmarks.board.tables import records_of
from benchmarks.command import run_main
from benchmarks.records import write_records
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
    write_file(config.out / "board.png", png_bytes(picture.draw(cells), dpi=110))
    write_records(config.out / "records.json", records_of(cells))
    if table := tables.screen_markdown(cells):
        print(table)
    print(config.out / "board.md")


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake, 130 for an interrupt, after which a run can go on."""
    choose_by_rule()
    again = "interrupted; the same command goes on"
    return run_main("board", BoardConfig, run, description=__doc__, words=words, interrupted=again)


if __name__ == "__main__":
    sys.exit(main())
