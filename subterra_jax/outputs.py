"""Whether something can be written, asked before hours are spent on it; nothing is left behind by asking."""

import tempfile
from pathlib import Path

from subterra_jax.errors import SubterraError


class OutputError(SubterraError):
    """An output that cannot be written."""


def require_folder(path: Path) -> Path:
    """The path itself, once it is known that a folder can be written there.

    Raises:
        OutputError: A file is in the way, there or in a parent, or the place takes no files.
    """
    place = next(place for place in (path, *path.absolute().parents) if place.exists())
    if not place.is_dir():
        raise OutputError(f"{place}: is a file, so no folder {path} can be written")
    _try(place, path)
    return path


def require_file(path: Path, *endings: str) -> Path:
    """The path itself, once it is known that a file can be written there.

    Args:
        path: The file.
        endings: What it may end in; anything where none is named.

    Raises:
        OutputError: It is a folder, ends otherwise, or its folder cannot be written.
    """
    if endings and path.suffix.lower() not in endings:
        raise OutputError(f"{path}: must end in {' or '.join(endings)}")
    if path.is_dir():
        raise OutputError(f"{path}: is a folder, not a file")
    require_folder(path.parent)
    return path


def _try(place: Path, wanted: Path) -> None:
    """Writes a file that vanishes at once: what permissions say is not what network and system folders do."""
    try:
        tempfile.TemporaryFile(dir=place).close()
    except OSError as error:
        raise OutputError(f"{wanted}: cannot be written ({place}: {error.strerror})") from error
