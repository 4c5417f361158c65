"""Recordings for SLAM programs, and scores of their poses.

Example: python -m benchmarks.slam record --scene build/tunnel --out out/slam/set
"""

import sys
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.results import environment_facts, write_file
from benchmarks.slam import report
from benchmarks.slam.errors import SlamError
from benchmarks.slam.recordings import SetConfig, make_set
from benchmarks.slam.run import RunConfig, run_all
from benchmarks.slam.score import ProgramScore, ScoreConfig, score_all
from subterra_jax.host.command import INPUT_ERRORS, parse, run_command

_progress = Console(stderr=True, highlight=False)

_PROG = "python -m benchmarks.slam"
_RECORD = f"""Record listed episodes, with the truth kept apart.

Example: {_PROG} record --scene build/tunnel --linings smooth pockets --out out/slam/set"""
_RUN = f"""Run a LiDAR odometry library on recordings.

Example: {_PROG} run --library kiss-icp --recordings out/slam/set --out out/slam/kiss-icp"""
_SCORE = f"""Score TUM files against the truth.

Example: {_PROG} score --estimate out/slam/kiss-icp --truth out/slam/set/truth --out out/slam/scores"""

Command = (
    Annotated[SetConfig, tyro.conf.subcommand("record", description=_RECORD)]
    | Annotated[RunConfig, tyro.conf.subcommand("run", description=_RUN)]
    | Annotated[ScoreConfig, tyro.conf.subcommand("score", description=_SCORE)]
)


def main(config: SetConfig | RunConfig | ScoreConfig) -> None:
    """Records, runs or scores.

    Raises:
        SubterraError: An input is missing or wrong, or an output cannot be written.
    """
    if isinstance(config, SetConfig):
        for name, existed in make_set(config):
            _progress.print(f"{name}: {'there already' if existed else 'recorded'}")
    elif isinstance(config, RunConfig):
        for name, result in run_all(config):
            _progress.print(f"{name}: {result}")
    else:
        scores = score_all(config)
        if config.out is not None:
            _write(config, scores)
        Console(width=190).print(_table(scores))


def _table(scores: list[ProgramScore]) -> Table:
    head, *rows = report.as_rows(scores)
    table = Table()
    for k, name in enumerate(head):
        table.add_column(name, justify="left" if k < 2 else "right")
    for row in rows:
        table.add_row(*row)
    return table


def _write(config: ScoreConfig, scores: list[ProgramScore]) -> None:
    assert config.out is not None
    content = {
        "scores.json": report.as_json(scores, environment_facts()).encode(),
        "scores.md": report.as_markdown(scores).encode(),
        "scores.png": report.as_png(scores),
    }
    try:
        config.out.mkdir(parents=True, exist_ok=True)
        for name, data in content.items():
            write_file(config.out / name, data)
    except OSError as error:
        raise SlamError(f"{config.out}: cannot be written ({error.strerror})") from error


def command(arguments: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    config = parse(lambda words: tyro.cli(Command, args=words, prog=_PROG, description=__doc__), arguments)
    return run_command(lambda: main(config), "interrupted; the same command goes on", mistakes=INPUT_ERRORS)


if __name__ == "__main__":
    sys.exit(command())
