"""Partial results beside the output: a build that was killed goes on where it was and gives the same bytes."""

import dataclasses
import fcntl
import hashlib
import json
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, Any

import numpy as np

from scene.progress import Stages
from subterra_jax.host.errors import OutputError

_CHUNK = 1 << 22
_LIBRARIES = ("numpy", "scipy", "small-gicp", "rosbags", "laspy", "lazrs", "pye57", "pyarrow", "plyfile", "pypcd4")


def total_bytes(paths: list[Path]) -> int:
    """Return the bytes of all inputs, a folder's files included."""
    return sum(file.stat().st_size for path in paths for file in _files(path))


def input_record(paths: list[Path], advance: Callable[[int], None] = lambda _: None) -> list[dict[str, Any]]:
    """Return name, size and hash of each input; no folder names, so that the record is the same anywhere.

    A folder of scans counts as one input, whose hash is that of its files' names and hashes. Each byte is read once,
    and `advance` is called with the number of bytes read since.
    """
    return [_folder_record(path, advance) if path.is_dir() else _file_record(path, advance) for path in paths]


def hash_inputs(paths: list[Path], progress: Stages) -> list[dict[str, Any]]:
    """Return name, size and hash of each input, read once from end to end."""
    return input_record(paths, progress.start("hashing the input, bytes", total_bytes(paths)).advance)


def resume_key(record: list[dict[str, Any]], *settings: Any) -> str:
    """Return a hex digest of all that partial results depend on: inputs, settings, libraries, and this code."""
    root = Path(__file__).parent
    source = hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        source.update(f"{file.relative_to(root)}\n".encode() + file.read_bytes())
    versions = library_versions(_LIBRARIES)
    text = json.dumps([record, settings, versions, source.hexdigest()], sort_keys=True, default=_json_value)
    return hashlib.sha256(text.encode()).hexdigest()


def library_versions(names: tuple[str, ...]) -> dict[str, str]:
    """Return the versions of those libraries that are installed; formats without theirs cannot have been read."""
    found = {}
    for name in names:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def _files(path: Path) -> list[Path]:
    return [file for file in sorted(path.iterdir()) if file.is_file()] if path.is_dir() else [path]


def _sha256(path: Path, advance: Callable[[int], None]) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_CHUNK):
            digest.update(block)
            advance(len(block))
    return digest.hexdigest()


def _file_record(path: Path, advance: Callable[[int], None]) -> dict[str, Any]:
    return {"file": path.name, "bytes": path.stat().st_size, "sha256": _sha256(path, advance)}


def _folder_record(path: Path, advance: Callable[[int], None]) -> dict[str, Any]:
    records = [_file_record(file, advance) for file in _files(path)]
    digest = hashlib.sha256("".join(f"{r['file']} {r['sha256']}\n" for r in records).encode())
    size = sum(record["bytes"] for record in records)
    return {"folder": path.name, "files": len(records), "bytes": size, "sha256": digest.hexdigest()}


def _json_value(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return value.tolist() if isinstance(value, np.ndarray) else str(value)


_WRITING_SHARE = 0.02  # of the time, at most, goes into writing partial results


class Partial:
    """The partial results of one build: named sets of arrays in a folder, each written whole or not at all.

    They count only for the key they were written under; others are discarded. A disk that refuses them stops the
    writing of partial results and not the build.

    Attributes:
        folder: Folder that they lie in; `None` keeps nothing.
        fresh: Start over, whatever lies there.
        every: Least time between two writings of a growing result, s; more where writing takes long. 0 writes at every
            occasion, whatever it costs.
    """

    def __init__(self, folder: Path | None, fresh: bool = False, every: float = 5.0) -> None:
        self.folder, self.fresh, self.every = folder, fresh, every
        self._lock: IO[str] | None = None
        self._open = False
        self._next = time.monotonic() + every

    def open(self, key: str) -> None:
        """Starts keeping results under a key; those under another key are discarded, which is said.

        Raises `OutputError` where another build is at work on the same output.
        """
        if self.folder is None:
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = (self.folder / "lock").open("w")
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            key_file = self.folder / "key"
            known = key_file.read_text() if key_file.is_file() else None
            if known is not None and known != key and not self.fresh:
                print("a partial result of another input, configuration or version was discarded", flush=True)
            if known != key or self.fresh:
                _clear(self.folder)
                (self.folder / "key.tmp").write_text(key)
                (self.folder / "key.tmp").replace(key_file)
            self._open = True
        except BlockingIOError as error:
            self.close()
            raise OutputError(f"{self.folder}: another build is at work on this output") from error
        except OSError as error:
            self._give_up(error)

    @property
    def keeps(self) -> bool:
        return self._open

    def due(self) -> bool:
        """Return whether it is time to write a growing result again; rarer where writing takes long."""
        return self._open and time.monotonic() >= self._next

    def save(self, name: str, **arrays: np.ndarray) -> None:
        """Writes a result under a name, in place of an older one; nothing where results are not kept."""
        if not self._open or self.folder is None:
            return
        started = time.monotonic()
        fresh = self.folder / f"{name}.tmp"
        try:
            with fresh.open("wb") as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]
            fresh.replace(self.folder / f"{name}.npz")
        except OSError as error:
            self._give_up(error)
        now = time.monotonic()
        self._next = now + max(self.every, (now - started) / _WRITING_SHARE if self.every else 0.0)

    def load(self, name: str) -> dict[str, np.ndarray] | None:
        """Return a result as it was saved; `None` where there is none that is whole."""
        if not self._open or self.folder is None:
            return None
        try:
            with np.load(self.folder / f"{name}.npz", allow_pickle=False) as archive:
                return dict(archive)  # the archive's checksums are tested on the way
        except Exception:  # absent, or damaged in whatever way: it is computed again
            return None

    def close(self) -> None:
        """Lets go of the folder; what lies there stays for the next build."""
        if self._lock is not None:
            self._lock.close()
        self._lock, self._open = None, False

    def discard(self) -> None:
        """Removes everything: the build is done, or its input is at fault."""
        if self.folder is not None and self._lock is not None:
            shutil.rmtree(self.folder, ignore_errors=True)
        self.close()

    def _give_up(self, error: OSError) -> None:
        print(f"no partial results are kept ({error.strerror or error}); a killed build starts over", flush=True)
        self.discard()


def partial_folder(out: Path) -> Path:
    """Return the folder for the partial results of a build that writes `out`."""
    return out.with_name(f".{out.name}.resume")


def _clear(folder: Path) -> None:
    for entry in folder.iterdir():
        if entry.name != "lock":
            entry.unlink()
