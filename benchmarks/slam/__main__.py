"""Recordings for SLAM programs, and scores of their poses.

Example: python -m benchmarks.slam arena --out out/arena
"""

import json
import sys
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.command import BenchmarkError, run_main
from benchmarks.records import write_records
from benchmarks.results import environment_facts, png_bytes, write_file
from benchmarks.slam import board_page, score
from benchmarks.slam.arena.sets import ArenaConfig, make_arena
from benchmarks.slam.board import BoardConfig, make_board
from benchmarks.slam.score import ScoreConfig, score_all

_progress = Console(stderr=True, highlight=False)

Command = (
    Annotated[ArenaConfig, tyro.conf.subcommand("arena")]
    | Annotated[BoardConfig, tyro.conf.subcommand("board")]
    | Annotated[ScoreConfig, tyro.conf.subcommand("score")]
)


def main(config: ArenaConfig | BoardConfig | ScoreConfig) -> None:
    """Records, runs or scores.

    Raises:
        SubterraError: An input is missing or wrong, or an output cannot be written.
    """
    if isinstance(config, ArenaConfig):
        for name, existed in make_arena(config):
            _progress.print(f"{name}: {'there already' if existed else 'recorded'}")
    elif isinstance(config, BoardConfig):
        for name, result in make_board(config):
            _progress.print(f"{name}: {result}")
        _write_board(config.out)
    else:
        scores, refused = score_all(config)
        for doubt in score.doubts(config, scores):
            _progress.print(f"warning: {doubt}", soft_wrap=True)
        if config.out is not None:
            write_file(config.out / "scores.json", score.as_json(scores, environment_facts()).encode())
            write_file(config.out / "scores.md", score.as_markdown(scores).encode())
        table = Table(*score.HEAD)
        for row in score.as_rows(scores):
            table.add_row(*row)
        Console(width=190).print(table)
        if refused:
            raise BenchmarkError("not scored: " + "; ".join(refused))


def _write_board(folder: Path) -> None:
    board = json.loads((folder / "board.json").read_text())
    write_file(folder / "board.md", board_page.as_markdown(board).encode())
    write_file(folder / "board.png", png_bytes(board_page.draw_board(board), dpi=130))
    write_records(folder / "records.json", board_page.records_of(board))
    print(board_page.as_markdown(board))


def command(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    again = "interrupted; the same command goes on"
    return run_main("slam", Command, main, description=__doc__, words=words, interrupted=again)  # type: ignore[arg-type]


if __name__ == "__main__":
    sys.exit(command())
