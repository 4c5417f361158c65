"""What a library says of a damaged file, as one clause of one sentence."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scene.errors import SubterraError

_LONGEST = 200


def one_line(text: str) -> str:
    """The text on one line, cut to 200 characters."""
    text = " ".join(text.split()).rstrip(".")
    return text if len(text) <= _LONGEST else text[:_LONGEST] + "…"


def cause(error: BaseException) -> str:
    """The error's text on one line; its type where it has none."""
    return one_line(str(error)) or type(error).__name__


@contextmanager
def refusing(path: Path, what: str, kind: type[SubterraError]) -> Iterator[None]:
    """Turns whatever the block raises into one sentence about `path`.

    Args:
        path: The file at fault.
        what: What the file is not, such as `a readable PLY cloud`.
        kind: Raised in its place; errors of this project pass as they are.
    """
    try:
        yield
    except (KeyboardInterrupt, SystemExit, GeneratorExit, SubterraError):
        raise
    except BaseException as error:  # libraries raise anything on damage; a panic in Rust is no `Exception`
        raise kind(f"{path}: not {what} ({cause(error)})") from error
