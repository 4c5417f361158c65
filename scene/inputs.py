"""Inputs of a build: names, sizes, hashes, versions of the libraries that read them; the manifest of a built scene."""

import hashlib
import json
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from scene.errors import RecordingError
from scene.progress import Stages

MANIFEST_SCHEMA = "subterra.manifest/1"
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


def read_manifest(folder: Path) -> dict[str, Any]:
    """Reads the manifest of a scene folder.

    Raises:
        RecordingError: It cannot be read, has another schema, or lacks a name, the frame's origin, inputs or files.
    """
    path = folder / "manifest.json"
    if not path.is_file():
        raise RecordingError(f"{folder}: not a scene folder, for it has no manifest.json; build it with scene.build")
    try:
        manifest: dict[str, Any] = json.loads(path.read_text())
        schema = manifest.get("schema")
    except (OSError, ValueError, AttributeError) as error:
        raise RecordingError(f"{path}: is no manifest ({error})") from error
    if schema != MANIFEST_SCHEMA:
        raise RecordingError(f"{path}: schema is {schema}, not {MANIFEST_SCHEMA}; build the scene anew")
    try:
        origin, inputs = np.asarray(manifest["frame"]["origin"], float), manifest.get("inputs", [])
        whole = origin.shape == (3,) and bool(np.isfinite(origin).all()) and isinstance(manifest["name"], str)
        whole &= isinstance(manifest.get("files", {}), dict) and all(isinstance(one, dict) for one in inputs)
    except (KeyError, TypeError, ValueError):
        whole = False
    if not whole:
        raise RecordingError(f"{path}: its name, frame, inputs or files are malformed; build the scene anew")
    return manifest
