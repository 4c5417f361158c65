"""What the commands of this room share: one sentence for a user's mistake, exit statuses, interrupts, tables."""

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.table import Table

from subterra_jax.errors import SubterraError
from train.errors import TrainingError

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130


class Interrupt:
    """Whether the user, or the machine's scheduler, has asked to stop."""

    def __init__(self) -> None:
        self.wanted = False


def run(command: Callable[[], int | None]) -> None:
    """Runs a command and exits with its status; a user's mistake ends as one sentence on stderr and status 2."""
    try:
        sys.exit(command() or 0)
    except SubterraError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(EXIT_FAILED if isinstance(error, TrainingError) else EXIT_BAD_INPUT)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(EXIT_INTERRUPTED)


@contextmanager
def deferred_interrupt() -> Iterator[Interrupt]:
    """Turns the first Ctrl-C (or SIGTERM) into a wish to stop at the next good moment; a second one stops at once."""
    interrupt = Interrupt()

    def note(number: int, frame: Any) -> None:
        if interrupt.wanted:
            raise KeyboardInterrupt
        interrupt.wanted = True

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield interrupt
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def table(title: str, values: dict[str, Any]) -> None:
    """Prints names and values."""
    console, grid = Console(), Table(show_header=False)
    for name, value in values.items():
        grid.add_row(name, f"{value:.4g}" if isinstance(value, float) else str(value))
    console.print(title, highlight=False)
    console.print(grid)
