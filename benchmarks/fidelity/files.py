"""Files: errors of requests, hashes, JSON and text that appear whole or not at all."""

import csv
import io
import json
from pathlib import Path
from typing import Any

from scene.inputs import input_record
from subterra_jax.host.errors import SubterraError
from subterra_jax.host.files import replace_file


class FidelityError(SubterraError):
    """User's mistake; its text is one sentence that names the file and the cause."""


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file, or of a folder's names and hashes, as the builder records its inputs."""
    return str(input_record([path])[0]["sha256"])


def write_text(path: Path, text: str) -> Path:
    with replace_file(path) as fresh:
        fresh.write_text(text)
    return path


def write_json(path: Path, content: Any, digits: int = 9) -> Path:
    """Writes sorted keys and rounded floats (17 digits keep all): the same result gives the same bytes."""
    return write_text(path, json.dumps(round_floats(content, digits), indent=1, sort_keys=True, allow_nan=False) + "\n")


def write_csv(path: Path, columns: tuple[str, ...], rows: list[dict[str, Any]]) -> Path:
    """Writes a CSV file; numbers with 6 significant digits, missing ones empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({c: f"{v:.6g}" if isinstance(v := row.get(c), float) else v for c in columns})
    return write_text(path, text.getvalue())


def read_kept(path: Path, schema: str, key: str) -> dict[str, Any]:
    """Return what an earlier command kept of the same case; nothing where there is no such file, or one of another.

    Raises:
        FidelityError: It is broken.
    """
    try:
        content: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    except (OSError, ValueError) as error:
        raise FidelityError(f"{path}: cannot be read ({error}); delete it to compute anew") from error
    return content if (content.get("schema"), content.get("key")) == (schema, key) else {}


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
