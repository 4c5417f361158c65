"""What went into a build: name, size and hash of each input, and a key under which its partial results are kept."""

import dataclasses
import hashlib
import json
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

_CHUNK = 1 << 22
_LIBRARIES = ("numpy", "scipy", "small-gicp", "rosbags", "laspy", "lazrs", "pye57", "pyarrow", "plyfile", "pypcd4")


def size_of(paths: list[Path]) -> int:
    """Bytes of all inputs, a folder's files included."""
    return sum(file.stat().st_size for path in paths for file in _files(path))


def input_record(paths: list[Path], advance: Callable[[int], None] = lambda _: None) -> list[dict[str, Any]]:
    """Name, size and hash of each input; no folder names, so that the record does not depend on the place.

    A folder of scans counts as one input, whose hash is that of its files' names and hashes.

    Args:
        paths: Files and folders; each byte is read once.
        advance: Called with the number of bytes that have been read since.
    """
    return [_folder_record(path, advance) if path.is_dir() else _file_record(path, advance) for path in paths]


def key_of(record: list[dict[str, Any]], *settings: Any) -> str:
    """What partial results depend on, as a hex digest: inputs, settings, libraries, and the source of this package."""
    root = Path(__file__).parent
    source = hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        source.update(f"{file.relative_to(root)}\n".encode() + file.read_bytes())
    versions = {name: version(name) for name in _LIBRARIES}
    text = json.dumps([record, settings, versions, source.hexdigest()], sort_keys=True, default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()


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


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return value.tolist() if isinstance(value, np.ndarray) else str(value)
