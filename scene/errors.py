"""Errors of a recording, each with one clear sentence."""

from pathlib import Path

from subterra_jax.host.errors import SubterraError


class RecordingError(SubterraError):
    """An input cannot be read, or is not what it says it is."""


class FitError(SubterraError):
    """The input was read, but no tunnel can be found or measured in it."""


def require_input(path: Path) -> Path:
    """Checks that an input exists and can be read, and returns its path.

    Raises:
        RecordingError: Nothing is there, or it cannot be opened.
    """
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder")
    if path.is_file():
        try:
            path.open("rb").close()
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    return path
