"""Files and folders that appear whole or not at all."""

import ctypes
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scene.errors import OutputError, RecordingError

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # Linux, renameat2(2)


def require_input(path: Path) -> Path:
    """The path itself, once it is known to exist and to be readable.

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


def require_output_folder(path: Path) -> Path:
    """The path itself, once it is known that a folder can be written there.

    Raises:
        OutputError: A file is in the way, there or in a parent, or the place takes no files.
    """
    for place in (path, *path.parents):
        if place.exists():
            if not place.is_dir():
                raise OutputError(f"{place}: is a file, so no folder {path} can be written")
            _try(place, path)
            break
    return path


def _try(place: Path, wanted: Path) -> None:
    """Writes a file that vanishes at once: what permissions say is not what network and system folders do."""
    try:
        tempfile.TemporaryFile(dir=place).close()
    except OSError as error:
        raise OutputError(f"{wanted}: cannot be written ({place}: {error.strerror})") from error


@contextmanager
def replace_folder(path: Path) -> Iterator[Path]:
    """A folder to write into that takes the place of `path` once the block ends without an error.

    A previous folder at `path` stays whole until then; after an error or an interrupt, nothing of the new one is left.
    What a killed process left behind is put right by the next one.

    Raises:
        OutputError: `path`, or a parent of it, is a file, or the disk refuses.
    """
    require_output_folder(path)
    fresh, stale = path.with_name(f".{path.name}.partial"), path.with_name(f".{path.name}.stale")
    try:
        _put_back(path, stale)
        shutil.rmtree(fresh, ignore_errors=True)
        fresh.mkdir(parents=True)
        yield fresh
        if path.exists() and not _exchange(fresh, path):
            path.rename(stale)
        if not path.exists():
            fresh.rename(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
        _put_back(path, stale)


def _put_back(path: Path, stale: Path) -> None:
    """Ends a replacement that stopped between its two renames."""
    if stale.exists() and not path.exists():
        stale.rename(path)
    shutil.rmtree(stale, ignore_errors=True)


def _exchange(one: Path, other: Path) -> bool:
    """Swaps two folders in one step, so that neither place is ever empty; `False` where the system cannot."""
    try:
        swap = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):  # no Linux, or one before 2014
        return False
    return swap(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) == 0
