"""Errors of a recording, each with one clear sentence."""

from enum import StrEnum
from pathlib import Path

from subterra_jax.host.errors import SubterraError


class RecordingError(SubterraError):
    """An input cannot be read, or is not what it says it is."""


class Refusal(StrEnum):
    """Why no bore can be built from a cloud, for programs; a bore that was built is refused by its warning's code."""

    NO_BORE = "no_bore"  # Nothing in it is enclosed, or lies on a wall around an open middle
    OPEN = "open"  # Open above: a street or a cutting
    PLANE = "plane"  # All points on one plane
    UPRIGHT = "upright"  # A vertical shaft
    ROOM = "room"  # Not longer than wide, or much wider than usual on the way
    NARROW = "narrow"  # Too narrow to be followed
    SHORT = "short"  # Shorter than the least length
    BRANCH = "branch"  # A branch, with `--strict`
    UNSEEN = "not_seen"  # Too little of the wall was seen, or profiles are too far apart
    FOLDED = "folded"  # Sections cut each other


class FitError(SubterraError):
    """The input was read, but no tunnel can be found or measured in it.

    Attributes:
        code: Word for programs, where there is one: of a `Refusal`, or of the warning that refuses the bore.
        page: HTML of the report that shows why; empty where there is none.
    """

    def __init__(self, message: str, code: str = "", page: str = "") -> None:
        super().__init__(message)
        self.code, self.page = code, page

    def about(self, message: str) -> "FitError":
        return type(self)(message, self.code, self.page)


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
