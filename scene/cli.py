"""What every command of this room shares: one sentence for a user's mistake, and a bar for long work."""

import sys
from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from scene.errors import SubterraError

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130


def run(command: Callable[[], None]) -> None:
    """Runs a command; a `SubterraError` ends as one sentence on stderr and exit status 2."""
    try:
        command()
    except SubterraError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(EXIT_BAD_INPUT)
    except KeyboardInterrupt:
        print("interrupted; nothing was written", file=sys.stderr)
        sys.exit(EXIT_INTERRUPTED)


def progress_bar() -> Progress:
    """A bar on stderr, silent where stderr is no terminal."""
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
    )
