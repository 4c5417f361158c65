"""Recordings for SLAM programs, and scores of their poses.

Example: python -m benchmarks.slam record --scene build/tunnel --out out/slam/set
"""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import matplotlib.pyplot as plt
import tyro
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from benchmarks.command import run_main
from benchmarks.records import write_records
from benchmarks.results import environment_facts, png_bytes, write_file
from benchmarks.slam.arena.sets import ArenaConfig, make_arena
from benchmarks.slam.board import BoardConfig, make_board
from benchmarks.slam.board_page import as_markdown as board_markdown
from benchmarks.slam.board_page import as_png as board_png
from benchmarks.slam.board_page import records_of as board_records
from benchmarks.slam.recordings import SetConfig, make_set
from benchmarks.slam.run import RunConfig, run_all
from benchmarks.slam.score import SCHEMA, ProgramScore, ScoreConfig, score_all
from benchmarks.slam.submission import SubmissionConfig, check_submission

_progress = Console(stderr=True, highlight=False)

_PROG = "python -m benchmarks.slam"
_RECORD = f"""Record listed episodes, with the truth kept apart.

Example: {_PROG} record --scene build/tunnel --linings smooth pockets --out out/slam/set"""
_ARENA = f"""Record the arena: drives for LiDAR-inertial programs, from smooth walls to rough ones.

Example: {_PROG} arena --out out/arena"""
_RUN = f"""Run a LiDAR odometry library on recordings.

Example: {_PROG} run --library kiss-icp --recordings out/slam/set --out out/slam/kiss-icp"""
_BOARD = f"""Run and score every program on sets of the arena.

Example: {_PROG} board --sets out/arena --out out/board --jobs 2"""
_CHECK = f"""Check that a submission can be scored, without the truth.

Example: {_PROG} check --submission mine --recordings out/arena"""
_SCORE = f"""Score TUM files against the truth.

Example: {_PROG} score --estimate out/slam/kiss-icp --truth out/slam/set/truth --out out/slam/scores"""

Command = (
    Annotated[SetConfig, tyro.conf.subcommand("record", description=_RECORD)]
    | Annotated[ArenaConfig, tyro.conf.subcommand("arena", description=_ARENA)]
    | Annotated[RunConfig, tyro.conf.subcommand("run", description=_RUN)]
    | Annotated[BoardConfig, tyro.conf.subcommand("board", description=_BOARD)]
    | Annotated[SubmissionConfig, tyro.conf.subcommand("check", description=_CHECK)]
    | Annotated[ScoreConfig, tyro.conf.subcommand("score", description=_SCORE)]
)
_HEAD = (
    "recording", "program", "driven, m", "covered %", "along at the end, m", "drift %", "along, m", "across, m",
    "up, m", "along % of pieces", "across % of pieces", "turn, °/m", "APE, m", "RPE, m",
)  # fmt: skip
_PANELS = (("along the axis", 0), ("across it", 1))
_STYLES = ("-", "--", ":", "-.")


def main(config: SetConfig | ArenaConfig | RunConfig | BoardConfig | SubmissionConfig | ScoreConfig) -> None:
    """Records, runs, checks or scores.

    Raises:
        SubterraError: An input is missing or wrong, or an output cannot be written.
    """
    if isinstance(config, SetConfig | ArenaConfig):
        for name, existed in make_set(config) if isinstance(config, SetConfig) else make_arena(config):
            _progress.print(f"{name}: {'there already' if existed else 'recorded'}")
    elif isinstance(config, RunConfig):
        for name, result in run_all(config):
            _progress.print(f"{name}: {result}")
    elif isinstance(config, BoardConfig):
        for name, result in make_board(config):
            _progress.print(f"{name}: {result}")
        board = _write_board(config.out)
        write_records(config.out / "records.json", board_records(board))
    elif isinstance(config, SubmissionConfig):
        print("\n".join(check_submission(config)))
    else:
        scores = score_all(config)
        if config.out is not None:
            _write(config.out, scores)
        Console(width=190).print(_table(scores))


def _table(scores: list[ProgramScore]) -> Table:
    head, *rows = as_rows(scores)
    table = Table()
    for k, name in enumerate(head):
        table.add_column(name, justify="left" if k < 2 else "right")
    for row in rows:
        table.add_row(*row)
    return table


def _write(folder: Path, scores: list[ProgramScore]) -> None:
    """Writes the scores as JSON, Markdown and figure."""
    write_file(folder / "scores.json", as_json(scores, environment_facts()).encode())
    write_file(folder / "scores.md", as_markdown(scores).encode())
    write_file(folder / "scores.png", as_png(scores))


def _write_board(folder: Path) -> dict[str, Any]:
    """Writes a board's table and figure beside its `board.json`, prints the table, and returns the board."""
    board = json.loads((folder / "board.json").read_text())
    write_file(folder / "board.md", board_markdown(board).encode())
    write_file(folder / "board.png", board_png(board))
    print(board_markdown(board))
    return board


def as_rows(scores: list[ProgramScore]) -> list[tuple[str, ...]]:
    """Returns the cells of the table, head first."""
    return [_HEAD, *(_row(one) for one in sorted(scores, key=lambda one: (one.score.name, one.program)))]


def as_markdown(scores: list[ProgramScore]) -> str:
    """Returns the table as Markdown, with a note on its columns."""
    rows = [f"| {' | '.join(row)} |" for row in as_rows(scores)]
    first = scores[0].score
    note = (
        f"Root mean squares over the recording, alignment `{first.alignment}`. Pieces are {first.piece:g} m of path: "
        "RMS error of their motion in % of it. APE and RPE are root mean squares as `evo` defines them."
    )
    return "\n".join([rows[0], "|" + "---|" * len(_HEAD), *rows[1:], "", note, ""])


def as_json(scores: list[ProgramScore], facts: dict[str, Any]) -> str:
    """Returns `scores.json`."""
    rows = [{"program": one.program, **one.score.as_dict()} for one in scores]
    return json.dumps({"schema": SCHEMA, **facts, "scores": rows}, indent=1, default=str) + "\n"


def _row(one: ProgramScore) -> tuple[str, ...]:
    score = one.score
    return (
        score.name, one.program, f"{score.distance:.1f}", f"{100.0 * score.covered:.0f}", f"{score.along_final:+.2f}",
        _cell(score.drift), f"{score.along_rms:.3f}", f"{score.across_rms:.3f}", f"{score.up_rms:.3f}",
        _cell(score.piece_along), _cell(score.piece_across), _cell(score.piece_turn, 3), f"{score.ape.rmse:.3f}",
        _cell(None if score.rpe is None else score.rpe.rmse, 3),
    )  # fmt: skip


def _cell(value: float | None, digits: int = 2) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def draw(scores: list[ProgramScore]) -> Figure:
    """Draws errors against distance: a colour for each program, a line style for each recording."""
    programs, names = (list(dict.fromkeys(values)) for values in zip(*((j.program, j.score.name) for j in scores),
                                                                     strict=True))  # fmt: skip
    figure, panels = plt.subplots(2, 1, figsize=(8.0, 6.0), sharex=True, layout="constrained")
    colours = plt.get_cmap("tab10")
    for axes, (title, part) in zip(panels, _PANELS, strict=True):
        for one in scores:
            style = _STYLES[names.index(one.score.name) % len(_STYLES)]
            axes.plot(
                one.curve.travelled, one.curve.error[:, part], style, color=colours(programs.index(one.program)),
                lw=1.4, label=f"{one.program}, {one.score.name}",
            )  # fmt: skip
        axes.axhline(0.0, color="0.6", lw=0.8, zorder=0)
        axes.set_ylabel(f"error {title}, m")
        axes.grid(alpha=0.3)
    panels[-1].set_xlabel("distance driven, m")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure


def as_png(scores: list[ProgramScore]) -> bytes:
    """Returns the figure as a PNG file."""
    return png_bytes(draw(scores), dpi=130)


def command(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    again = "interrupted; the same command goes on"
    return run_main("slam", Command, main, description=__doc__, words=words, interrupted=again)  # type: ignore[arg-type]


if __name__ == "__main__":
    sys.exit(command())
