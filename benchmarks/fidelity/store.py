"""Values and results as JSON files that appear whole or not at all."""

import json
from collections.abc import Iterable
from dataclasses import asdict
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.errors import FidelityError
from benchmarks.fidelity.value import Value

SCHEMA = "subterra.fidelity-values/1"
NOT_VALUES = (
    "report",
    "figures",
    "__main__.py",
    "commands.py",
    "memory.py",
    "inputs.py",
    "judge.py",
    "scoring.py",
    "sweep.py",
    "calibrate.py",
    "evidence.py",
    "rules.py",
    "split.py",
    "table.py",
    "controls",
)  # what no raw value of a case depends on; what a control does has its own key


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
    """Sorted keys, no NaN, floats rounded to some digits (17 keep all): the same result gives the same bytes."""
    return write_text(path, json.dumps(rounded(content, digits), indent=1, sort_keys=True, allow_nan=False) + "\n")


def read_json(path: Path, schema: str) -> dict[str, Any]:
    """A file written by `write_json`.

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


def rounded(content: Any, digits: int = 9) -> Any:
    """Floats to some significant digits, numpy numbers to Python's, anything not finite to `None`."""
    if isinstance(content, dict):
        return {str(key): rounded(value, digits) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [rounded(value, digits) for value in content]
    if hasattr(content, "item"):
        content = content.item()
    if isinstance(content, float):
        return float(f"{content:.{digits}g}") if abs(content) < float("inf") else None
    return content


def dump_values(values: dict[str, Value]) -> dict[str, Any]:
    """Values as plain data."""
    return {id: asdict(value) for id, value in values.items()}


def load_values(content: dict[str, Any]) -> dict[str, Value]:
    """The reverse of `dump_values`."""
    return {
        id: Value(**{**entry, "interval": tuple(entry["interval"]) if entry["interval"] else None})
        for id, entry in content.items()
    }


@cache
def code_hash() -> str:
    """SHA-256 of the code that raw values depend on: a result of other code is not taken up again.

    Thresholds, roles and required falls are not part of it: they are applied to kept values at no cost.
    """
    here = Path(__file__).parent
    return _hash_of(file for file in here.rglob("*.py") if file.relative_to(here).parts[0] not in NOT_VALUES)


@cache
def controls_hash() -> str:
    """SHA-256 of the code of the controls; what they must do is no part of it."""
    here = Path(__file__).parent / "controls"
    return _hash_of(file for file in here.glob("*.py") if file.name != "verdicts.py")


def _hash_of(files: Iterable[Path]) -> str:
    digest = sha256()
    for file in sorted(files):
        digest.update(file.relative_to(Path(__file__).parent).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()


def case_hash(case: Case) -> str:
    """SHA-256 of what is judged and against what, with seed and tolerance."""
    digest = sha256(f"{code_hash()} {case.seed} {case.tolerance}".encode())
    digest.update(candidate_hash(case.candidate).encode())
    for hold in (case.hold, case.fit):
        digest.update(b"none" if hold is None else f"{hold.hash} {len(hold.range)}".encode())
    if case.truth is not None:
        digest.update(case.truth.surface.vertices.tobytes() + case.truth.position.tobytes())
    return digest.hexdigest()


def candidate_hash(candidate: Candidate) -> str:
    """SHA-256 of a candidate's geometry and scene."""
    digest = sha256(json.dumps(candidate.manifest, sort_keys=True, default=str).encode())
    for mesh in (
        candidate.lining,
        candidate.solid,
        candidate.extra,
        candidate.nails,
        candidate.bed,
        candidate.track.sleeper_mesh,
        candidate.track.rail_mesh,
    ):
        digest.update(mesh.vertices.tobytes() + mesh.faces.tobytes())
    digest.update(candidate.bore.position.tobytes() + candidate.bore.radius.tobytes())
    for file in (candidate.scene, candidate.tunnel):
        digest.update(file.read_bytes() if file.exists() else b"none")
    return digest.hexdigest()
