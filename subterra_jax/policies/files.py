"""Policies on disk: tensors in `NAME.safetensors`, everything else in `NAME.json` beside it.

A safetensors file is eight bytes of header length, little-endian, a JSON header with type, shape and place of every
tensor, and their bytes. Tensors of 16 and of 32 bits are used here. Format: github.com/huggingface/safetensors, README.
"""

import hashlib
import json
import struct
from dataclasses import asdict, dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np

from subterra_jax.host.errors import SubterraError
from subterra_jax.host.versions import other_schema

SCHEMA = "subterra.policy/1"
AGAIN = "release it again from its run folder with `python -m train.release`"
TENSORS, FACTS = ".safetensors", ".json"
CHECKPOINTS, CHECKPOINT_POLICY = "checkpoint", "policy"  # of a run folder: numbered checkpoints, a policy in each
_TYPES = {"F32": "<f4", "F16": "<f2"}  # of tensors on disk; in memory all are float32
GAIT = "walk"  # the kind that moves legs and drives no task
TRAINED_UNDER = "trained_under"  # field of the facts
_FACTS = ("name", "kind", "task", "layout", "tensors_sha256")


class PolicyError(SubterraError):
    """A policy is missing, damaged, or does not fit the task."""


@dataclass(frozen=True)
class Conditions:
    """Conditions that a policy was trained under; it drives under no others."""

    task: str  # task id
    period: float  # control period, s
    n_beams: int | None = None  # beams of a scan; None: unknown
    fields: tuple[str, ...] | None = None  # names of the parts of the observation, in order; None: unknown
    constants: str | None = None  # digest of the benchmark's constants; None: unknown

    @classmethod
    def from_facts(cls, facts: dict[str, Any]) -> "Conditions":
        known = dict(facts[TRAINED_UNDER])
        fields = known.pop("fields", None)
        return cls(facts["task"], **known, fields=None if fields is None else tuple(fields))

    def to_json(self) -> dict[str, Any]:
        """Returns what `from_facts` reads under `TRAINED_UNDER`."""
        values = asdict(self)
        del values["task"]
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class PolicyFile:
    """A policy as it was read."""

    path: str  # the tensors' file, for messages
    # the JSON file: name, kind (`ppo`, `locate` or `walk`), task, layout, and where it comes from
    facts: dict[str, Any]
    tensors: dict[str, np.ndarray]  # by name


def released() -> dict[str, Traversable]:
    """The packaged policies by name."""
    folder = _folder()
    if not folder.is_dir():
        return {}
    found = {entry.name.removesuffix(TENSORS): entry for entry in folder.iterdir() if entry.name.endswith(TENSORS)}
    return dict(sorted(found.items()))


def _folder() -> Traversable:
    return resources.files("subterra_jax") / "data" / "policies"


def name_for(task: str) -> str:
    """Name of the released policy of a task: `StopAt-v1` for `Subterra/StopAt-v1`."""
    return task.removeprefix("Subterra/")


def is_policy(source: str) -> bool:
    """Returns True for the name of a released policy, for what ends in `.safetensors`, and for a folder."""
    return source in released() or source.endswith(TENSORS) or Path(source).is_dir()


def read(source: str | Path) -> PolicyFile:
    """Reads a policy.

    Args:
        source: A `.safetensors` file with its `.json` beside it; a run folder of `train`, or one checkpoint in it; or
            the name of a released policy.

    Raises:
        PolicyError: It is missing, damaged, or its two files do not belong together.
    """
    tensors, facts = _find(str(source))
    content = tensors.read_bytes()
    return PolicyFile(str(source), _facts(facts, content), parse(content, str(source)))


def read_facts(source: str | Path) -> dict[str, Any]:
    """Reads the facts of a policy; `source` and errors as for `read`."""
    tensors, facts = _find(str(source))
    return _facts(facts, tensors.read_bytes())


def _find(source: str) -> tuple[Traversable, Traversable]:
    """Returns the files of tensors and facts.

    Raises:
        PolicyError: There are none.
    """
    packaged = released()
    if source in packaged:
        return packaged[source], _folder() / (source + FACTS)
    tensors = Path(source)
    if tensors.is_dir():
        tensors = _newest_checkpoint(tensors) / (CHECKPOINT_POLICY + TENSORS)
        if not tensors.is_file():
            raise PolicyError(f"{source}: holds no {CHECKPOINT_POLICY}{TENSORS}; {AGAIN}")
    if not tensors.is_file():
        raise PolicyError(f"{source}: no such policy; released are {', '.join(packaged) or 'none'}")
    return tensors, tensors.with_name(tensors.name.removesuffix(TENSORS) + FACTS)


def _newest_checkpoint(folder: Path) -> Path:
    """Returns the newest checkpoint of a run folder; itself where it is one, or holds none."""
    for place in (folder / CHECKPOINTS, folder):
        if numbered := [entry for entry in place.glob("*") if entry.name.isdigit()]:
            return max(numbered, key=lambda entry: int(entry.name))
    return folder


def parse(content: bytes, name: str) -> dict[str, np.ndarray]:
    """The tensors of a safetensors file.

    Raises:
        PolicyError: It is cut short or is something else; the message begins with `name`.
    """
    try:
        (size,) = struct.unpack("<Q", content[:8])
        header, data = json.loads(content[8 : 8 + size]), content[8 + size :]
        header.pop("__metadata__", None)
        return {key: _tensor(entry, data) for key, entry in header.items()}
    except (struct.error, ValueError, KeyError, TypeError, AttributeError) as error:
        raise PolicyError(f"{name}: damaged policy: not a readable safetensors file ({error})") from error


def _tensor(entry: dict[str, Any], data: bytes) -> np.ndarray:
    begin, end = entry["data_offsets"]
    if entry["dtype"] not in _TYPES:
        raise ValueError(f"type {entry['dtype']}, not {' or '.join(_TYPES)}")
    if end > len(data):
        raise ValueError(f"{len(data)} bytes of tensors, not {end}")
    return np.frombuffer(data[begin:end], _TYPES[entry["dtype"]]).astype(np.float32).reshape(entry["shape"])


def _facts(path: Traversable, tensors: bytes) -> dict[str, Any]:
    try:
        facts = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise PolicyError(f"{path}: damaged policy: no readable facts") from error
    found = facts.get("schema") if isinstance(facts, dict) else None
    if found != SCHEMA:
        raise PolicyError(f"{path}: {other_schema(found, SCHEMA, AGAIN)}")
    if missing := [name for name in _FACTS if name not in facts]:
        raise PolicyError(f"{path}: field {missing[0]!r} is missing")
    if hashlib.sha256(tensors).hexdigest() != facts["tensors_sha256"]:
        raise PolicyError(f"{path}: damaged policy: the tensors beside it have another SHA-256")
    return facts
