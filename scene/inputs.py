"""Inputs and libraries of a build: name, size and hash of its inputs, and versions of the libraries that read them."""

import hashlib
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from scene.progress import Stages

_CHUNK = 1 << 22  # bytes read at once


def input_record(paths: list[Path], advance: Callable[[int], None] = lambda _: None) -> list[dict[str, Any]]:
    """Return name, size and hash of each input; no folder names, so that the record is the same anywhere.

    A folder of scans counts as one input, whose hash is that of its files' names and hashes. Each byte is read once,
    and `advance` is called with the number of bytes read since.
    """
    return [_folder_record(path, advance) if path.is_dir() else _file_record(path, advance) for path in paths]


def hash_inputs(paths: list[Path], progress: Stages) -> list[dict[str, Any]]:
    """Return the record of some inputs, as a stage of a build."""
    total = sum(file.stat().st_size for path in paths for file in input_files(path))
    return input_record(paths, progress.start("hashing the input, bytes", total).advance)


def library_versions(names: tuple[str, ...]) -> dict[str, str]:
    """Return the versions of those libraries that are installed; formats without theirs cannot have been read."""
    found = {}
    for name in names:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def input_files(path: Path) -> list[Path]:
    """Return the files of an input: those of a folder, or itself."""
    return [file for file in sorted(path.iterdir()) if file.is_file()] if path.is_dir() else [path]


def _file_record(path: Path, advance: Callable[[int], None]) -> dict[str, Any]:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_CHUNK):
            digest.update(block)
            advance(len(block))
    return {"file": path.name, "bytes": path.stat().st_size, "sha256": digest.hexdigest()}


def _folder_record(path: Path, advance: Callable[[int], None]) -> dict[str, Any]:
    records = [_file_record(file, advance) for file in input_files(path)]
    digest = hashlib.sha256("".join(f"{r['file']} {r['sha256']}\n" for r in records).encode())
    size = sum(record["bytes"] for record in records)
    return {"folder": path.name, "files": len(records), "bytes": size, "sha256": digest.hexdigest()}
