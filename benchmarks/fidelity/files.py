"""Files: errors of requests, hashes, JSON and text that appear whole or not at all."""

import json
from pathlib import Path
from typing import Any

from scene.resume import input_record
from subterra_jax.host.errors import SubterraError


class FidelityError(SubterraError):
    """User's mistake; its text is one sentence that names the file and the cause."""


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file, or of a folder's names and hashes, as the builder records its inputs."""
    return str(input_record([path])[0]["sha256"])


def write_text(path: Path, text: str) -> Path:
    """Writes a file under a temporary name and renames it.

    Raises:
        FidelityError: It cannot be written there.
    """
    fresh = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh.write_text(text)
        fresh.replace(path)
    except OSError as error:
        raise FidelityError(f"{path}: cannot be written ({error.strerror})") from error
    return path


def write_json(path: Path, content: Any, digits: int = 9) -> Path:
    """Writes sorted keys and rounded floats (17 digits keep all): the same result gives the same bytes."""
    return write_text(path, json.dumps(round_floats(content, digits), indent=1, sort_keys=True, allow_nan=False) + "\n")


def read_json(path: Path, schema: str) -> dict[str, Any]:
    """Reads a file written by `write_json`.

    Raises:
        FidelityError: Missing, broken, or of another schema.
    """
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise FidelityError(f"{path}: cannot be read ({error})") from error
    if not isinstance(content, dict) or content.get("schema") != schema:
        raise FidelityError(f"{path}: schema is not {schema}")
    return content


def round_floats(content: Any, digits: int = 9) -> Any:
    """Rounds floats to significant digits, turns numpy numbers into Python's, and NaN and infinity into `None`."""
    if isinstance(content, dict):
        return {str(key): round_floats(value, digits) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [round_floats(value, digits) for value in content]
    if hasattr(content, "item"):
        content = content.item()
    if isinstance(content, float):
        return float(f"{content:.{digits}g}") if abs(content) < float("inf") else None
    return content
