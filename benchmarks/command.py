"""How the commands of this room end: a user's mistake in one sentence and with status 2."""

import sys
from collections.abc import Callable

import scene.errors
from subterra_jax.errors import SubterraError
from train.errors import TrainingError

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130
MISTAKES = (SubterraError, scene.errors.SubterraError, ValueError, OSError)


def status(act: Callable[[], int | None], interrupted: str = "interrupted") -> int:
    """Runs a command; its exit status.

    Args:
        act: The command; what it returns is the status, nothing is 0.
        interrupted: What is said after Ctrl-C.

    Returns:
        Its own status; 2 after a user's mistake, which is told as one sentence on stderr; 1 where a training failed;
        130 after Ctrl-C.
    """
    try:
        return act() or 0
    except MISTAKES as error:
        print(f"error: {sentence(error)}", file=sys.stderr)
        return EXIT_FAILED if isinstance(error, TrainingError) else EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print(interrupted, file=sys.stderr)
        return EXIT_INTERRUPTED


def sentence(error: BaseException) -> str:
    """What an error says, on one line; the system's own begin with the file."""
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())
