"""Output of a run while it trains: a bar for people, a line per iteration for programs, and TensorBoard."""

import json
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from subterra_jax.host.files import replace_file

LOG, TABLE, EPISODES = "log.jsonl", "log.csv", "episodes.csv"
_HEADER = "episode,step,coverage,success,length,contact"
_PLAIN_EVERY = 10.0


class RunLog:
    """`log.jsonl`, the same as `log.csv`, and `episodes.csv` of a run folder, flushed after every iteration.

    Args:
        run: The run folder.
        iteration: Iterations to keep of an earlier log; 0 begins anew.
        episodes: Episodes to keep.
    """

    def __init__(self, run: Path, iteration: int = 0, episodes: int = 0) -> None:
        # A killed run may have logged more than its last checkpoint knows; those iterations come again.
        _keep_lines(run / LOG, iteration)
        _keep_lines(run / TABLE, iteration + 1 if iteration else 0)
        _keep_lines(run / EPISODES, episodes + 1 if iteration else 0)
        self._log: TextIO = (run / LOG).open("a")
        self._table: TextIO = (run / TABLE).open("a")
        self._episodes: TextIO = (run / EPISODES).open("a")
        if not self._episodes.tell():
            self._episodes.write(_HEADER + "\n")

    def write(self, record: dict[str, Any], rows: np.ndarray) -> None:
        """Adds one iteration and the episodes that finished in it."""
        self._log.write(json.dumps(record, allow_nan=False) + "\n")
        flat = {**record, **record["timing"]}
        del flat["timing"]
        if not self._table.tell():
            self._table.write(",".join(flat) + "\n")
        self._table.write(",".join(map(_cell, flat.values())) + "\n")
        for row in rows:
            self._episodes.write(
                f"{row['episode']},{row['step']},{row['coverage']:.9g},{row['success']:d},{row['length']},{row['contact']:d}\n"
            )
        for file in (self._log, self._table, self._episodes):
            file.flush()

    def close(self) -> None:
        """Closes the files."""
        for file in (self._log, self._table, self._episodes):
            file.close()


class Bar:
    """Progress on stderr: steps, steps/s, success, time left. A line now and then where it is no terminal.

    Args:
        steps: Steps to train for.
        done: Steps done before.
        covers: Show coverage too.
    """

    def __init__(self, steps: int, done: int = 0, covers: bool = False) -> None:
        self._console, self._steps, self._covers = Console(stderr=True), steps, covers
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            TextColumn("left at most"),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._task = self._progress.add_task("compiling", total=steps, completed=done)
        self._told = time.monotonic()
        self._progress.start()
        if self._progress.disable:
            self._console.print("compiling")

    def show(self, record: dict[str, Any], of: str = "") -> None:
        """Shows one iteration, of one of several runs where it is named."""
        coverage = f"coverage {_percent(record['coverage_mean_100'])}  " if self._covers else ""
        text = (
            f"{of + '  ' if of else ''}{record['step']:,} steps  {record['timing']['steps_per_second']:,}/s  "
            f"{coverage}success {_percent(record['success_mean_100'])}"
        )
        self._progress.update(self._task, completed=record["step"], description=text)
        if self._progress.disable and time.monotonic() - self._told > _PLAIN_EVERY:
            left = (self._steps - record["step"]) / max(record["timing"]["steps_per_second"], 1)
            self._console.print(f"{text}  at most {left:,.0f} s left")
            self._told = time.monotonic()

    def close(self) -> None:
        """Leaves the bar as it is."""
        self._progress.stop()


def read_log(run: Path) -> list[dict[str, Any]]:
    """Reads every line of a run's log."""
    return [json.loads(line) for line in (run / LOG).read_text().splitlines()]


def _cell(value: float | None) -> str:
    return "" if value is None else str(value) if isinstance(value, int) else f"{value:.9g}"


def _percent(fraction: float | None) -> str:
    return "none yet" if fraction is None else f"{100.0 * fraction:.1f} %"


def _keep_lines(path: Path, count: int) -> None:
    """Cuts a file after its first `count` lines."""
    if not path.exists():
        return
    lines = path.read_text().splitlines(keepends=True)[:count]
    with replace_file(path) as fresh:
        fresh.write_text("".join(lines))


class Interrupt:
    """A request of the user, or of the machine's scheduler, to stop."""

    def __init__(self) -> None:
        self.needed = False


@contextmanager
def deferred_interrupt() -> Iterator[Interrupt]:
    """Turns the first Ctrl-C (or SIGTERM) into a wish to stop at the next good moment; a second one stops at once."""
    interrupt = Interrupt()

    def note(number: int, frame: Any) -> None:
        if interrupt.needed:
            raise KeyboardInterrupt
        interrupt.needed = True

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield interrupt
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def print_table(title: str, values: dict[str, Any]) -> None:
    """Prints names and values."""
    console, grid = Console(), Table(show_header=False)
    for name, value in values.items():
        grid.add_row(name, f"{value:.4g}" if isinstance(value, float) else str(value))
    console.print(title, highlight=False, emoji=False)  # `:train:` of a tunnel's name is a tram
    console.print(grid)
