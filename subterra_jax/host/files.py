"""Files and folders that appear whole or not at all, early checks that they can be written, and the cache folder."""

import glob
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from subterra_jax.host.errors import OutputError


def require_folder(path: Path, mark: str | None = None) -> Path:
    """Checks that a folder can be written, without leaving anything behind, and returns its path.

    Args:
        mark: File that an earlier output holds, where the folder will be replaced whole.

    Raises:
        OutputError: A file is in the way, at `path` or at a parent, the disk refuses, or what would be replaced is no
            earlier output.
    """
    if mark is not None and not path.name:
        raise OutputError(f"{path}: is the working folder, which is not replaced; name a folder in it")
    if mark is not None and path.is_dir() and not (path / mark).is_file() and any(path.iterdir()):
        raise OutputError(f"{path}: is no earlier output of this command, for it holds no {mark}; it is not replaced")
    place = next(place for place in (path, *path.absolute().parents) if place.exists())
    if not place.is_dir():
        raise OutputError(f"{place}: is a file, so no folder {path} can be written")
    try:
        # Permissions do not tell what network and system folders do, so write a file that vanishes at once.
        tempfile.TemporaryFile(dir=place).close()
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({place}: {error.strerror})") from error
    return path


def require_file(path: Path, *endings: str) -> Path:
    """Checks that a file can be written, without leaving anything behind, and returns its path.

    Args:
        *endings: Endings that it may have; any where none is given.

    Raises:
        OutputError: It is a folder, has another ending, or its folder cannot be written.
    """
    if endings and path.suffix.lower() not in endings:
        raise OutputError(f"{path}: must end in {' or '.join(endings)}")
    if path.is_dir():
        raise OutputError(f"{path}: is a folder, not a file")
    require_folder(path.parent)
    return path


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Yields a temporary path to write, and renames it to `path` once the block ends without an error.

    A previous file at `path` stays whole until then. The folder is made where it is missing. After an error or an
    interrupt, nothing of the new file is left. Of several processes that write the same file, the last one's stays.

    Raises:
        OutputError: The disk refuses.
    """
    fresh = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_forgotten(path)
        yield fresh
        fresh.replace(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        _remove(fresh)


@contextmanager
def replace_folder(path: Path, mark: str | None = None) -> Iterator[Path]:
    """Yields a temporary folder to write, which takes the place of `path` once the block ends without an error.

    A previous folder at `path` stays whole until then; after an error or an interrupt, nothing of the new one is left.
    The next call repairs what a killed process left behind.

    Raises:
        OutputError: See `require_folder`, which takes the same `mark`.
    """
    require_folder(path, mark)
    fresh, stale = path.with_name(f".{path.name}.partial"), path.with_name(f".{path.name}.stale")
    try:
        _put_back(path, stale)
        shutil.rmtree(fresh, ignore_errors=True)
        fresh.mkdir(parents=True)
        yield fresh
        if path.exists():
            path.rename(stale)
        fresh.rename(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
        _put_back(path, stale)


def _remove_forgotten(path: Path) -> None:
    """Removes what killed processes left of a file; nothing is written for a day."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.partial"):
        with suppress(OSError):
            if left.stat().st_mtime < time.time() - 86_400:
                left.unlink()


def _remove(path: Path) -> None:
    with suppress(OSError):
        path.unlink(missing_ok=True)


def _put_back(path: Path, stale: Path) -> None:
    """Ends a replacement that stopped between its two renames."""
    if stale.exists() and not path.exists():
        stale.rename(path)
    shutil.rmtree(stale, ignore_errors=True)


def cache_folder(name: str) -> Path:
    """Return the folder of what can be made again; it need not exist, and may be deleted at any time."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "subterra" / name


def make_writable(folder: Path) -> bool:
    """Make a folder if it is not there, and tell whether it can be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)
