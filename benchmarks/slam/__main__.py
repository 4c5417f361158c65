"""Recordings for SLAM programs, and scores of their poses.

Example: python -m benchmarks.slam record --scene build/tunnel --out out/slam/set
"""

import sys
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from benchmarks import command as ending
from benchmarks.slam import figure, report
from benchmarks.slam.errors import SlamError
from benchmarks.slam.judge import Judged, ScoreConfig, judge
from benchmarks.slam.recordset import SetConfig, make_set
from benchmarks.slam.trial import RunConfig, run_all
from benchmarks.throughput.facts import environment_facts
from scene.arguments import parse

_progress = Console(stderr=True, highlight=False)

_PROG = "python -m benchmarks.slam"
_RECORD = f"""Record listed episodes, the truth held apart.

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
    """Runs one of the three.

    Raises:
        SubterraError: Something that was asked for is not there, or cannot be written.
    """
    if isinstance(config, SetConfig):
        for name, there in make_set(config):
            _progress.print(f"{name}: {'there already' if there else 'recorded'}")
    elif isinstance(config, RunConfig):
        for name, what in run_all(config):
            _progress.print(f"{name}: {what}")
    else:
        found = judge(config)
        if config.out is not None:
            _write(config, found)
        Console(width=190).print(_table(found))


def _table(found: list[Judged]) -> Table:
    head, *rows = report.as_rows(found)
    shown = Table()
    for k, name in enumerate(head):
        shown.add_column(name, justify="left" if k < 2 else "right")
    for row in rows:
        shown.add_row(*row)
    return shown


def _write(config: ScoreConfig, found: list[Judged]) -> None:
    assert config.out is not None
    content = {
        "scores.json": report.as_json(found, environment_facts()).encode(),
        "scores.md": report.as_markdown(found).encode(),
        "scores.png": figure.as_png(found),
    }
    try:
        config.out.mkdir(parents=True, exist_ok=True)
        for name, data in content.items():
            partial = config.out / f".{name}.partial"
            partial.write_bytes(data)
            partial.replace(config.out / name)
    except OSError as error:
        raise SlamError(f"{config.out}: cannot be written ({error.strerror})") from error


def command(arguments: list[str] | None = None) -> int:
    """The command line; a user's mistake is one sentence and status 2."""
    config = parse(lambda words: tyro.cli(Command, args=words, prog=_PROG, description=__doc__), arguments)
    return ending.status(lambda: main(config), "interrupted; the same command goes on")


if __name__ == "__main__":
    sys.exit(command())
