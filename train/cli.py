"""Interrupts and tables of the commands of this room."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.table import Table


class Interrupt:
    """Whether the user, or the machine's scheduler, has asked to stop."""

    def __init__(self) -> None:
        self.wanted = False


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
