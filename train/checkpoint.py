"""Checkpoints of a run: arrays by Orbax, everything else in JSON, and the policy as `subterra_jax` loads it.

Each is written under a temporary name and renamed, so that a kill at any moment leaves the one before it whole. A
digest of all arrays is kept in the JSON file: a damaged array is an error, never a policy.
"""

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from subterra_jax.host.errors import SubterraError
from subterra_jax.host.files import replace_folder
from subterra_jax.host.versions import other_schema
from subterra_jax.policies.files import CHECKPOINTS as FOLDER

SCHEMA = "subterra.checkpoint/1"
FACTS, ARRAYS = "checkpoint.json", "arrays"
_KEPT = 2


class CheckpointError(SubterraError):
    """A checkpoint is missing, damaged, or belongs to another network or run."""


@dataclasses.dataclass(frozen=True)
class Stored:
    """A checkpoint as read: checked against its digest, not yet against any network."""

    path: Path  # folder of the checkpoint
    facts: dict[str, Any]  # the JSON file
    arrays: dict[str, np.ndarray]  # every array, by the name of its place

    def restore(self, name: str, like: Any) -> Any:
        """Restores one of the trees that were saved.

        Args:
            name: Name that it was saved under.
            like: A tree of the same structure, its leaves of the shapes and types needed, as from `jax.eval_shape`.

        Raises:
            CheckpointError: An array is missing, or of another shape or type.
        """
        paths, structure = jax.tree_util.tree_flatten_with_path(like)
        leaves = []
        for path, needed in paths:
            place = _place(name, path)
            if place not in self.arrays:
                raise CheckpointError(f"{self.path}: has no {place}; it was made for another network")
            leaf = self.arrays[place]
            if leaf.shape != needed.shape or leaf.dtype != needed.dtype:
                raise CheckpointError(
                    f"{self.path}: made for another network: {place} is {leaf.dtype}{list(leaf.shape)}, "
                    f"this one needs {needed.dtype}{list(needed.shape)}"
                )
            leaves.append(leaf)
        return jax.tree.unflatten(structure, leaves)


def save_checkpoint(
    run: Path,
    iteration: int,
    trees: dict[str, Any],
    facts: dict[str, Any],
    add: Callable[[Path], None] | None = None,
) -> Path:
    """Writes `run/checkpoint/<iteration>` and forgets all but the last two.

    Args:
        run: The run folder.
        iteration: Names the checkpoint.
        trees: Pytrees of arrays, by name.
        facts: Values that JSON can hold; `schema` and `digest` are added.
        add: Writes further files into the checkpoint's folder.

    Returns:
        Where it is.
    """
    arrays = {
        _place(name, path): np.asarray(leaf)
        for name, tree in trees.items()
        for path, leaf in jax.tree_util.tree_flatten_with_path(jax.device_get(tree))[0]
    }
    shapes = {name: list(array.shape) for name, array in arrays.items()}
    # Orbax takes no array without numbers, as the memory of a network without one is.
    empty = {name: str(array.dtype) for name, array in arrays.items() if array.size == 0}
    whole = {"schema": SCHEMA, **facts, "shapes": shapes, "empty": empty, "digest": _digest(arrays)}
    place = run / FOLDER / f"{iteration:08d}"
    with replace_folder(place) as fresh:
        # At least one axis each: Orbax gives scalars back as Python numbers.
        kept = {name: np.atleast_1d(array) for name, array in arrays.items() if array.size}
        ocp.PyTreeCheckpointer().save((fresh / ARRAYS).resolve(), kept)
        (fresh / FACTS).write_text(json.dumps(whole, indent=1) + "\n")
        if add is not None:
            add(fresh)
    for old in _numbered(run / FOLDER)[:-_KEPT]:
        remove_folder(old)
    for leftover in (run / FOLDER).glob(".*"):
        shutil.rmtree(leftover, ignore_errors=True)
    return place


def remove_folder(folder: Path) -> None:
    """Removes a folder so that nobody ever finds half of it: it is renamed first."""
    if folder.exists():
        gone = folder.with_name(f".{folder.name}.gone")
        if gone.exists():  # of a process that was killed here
            shutil.rmtree(gone)
        folder.rename(gone)
        shutil.rmtree(gone, ignore_errors=True)


def load_checkpoint(folder: Path, iteration: int | None = None) -> Stored:
    """Reads the newest checkpoint of a run folder, or that of an iteration, or the checkpoint that `folder` itself is.

    Raises:
        CheckpointError: There is none, or it is damaged.
    """
    place = _find(folder) if iteration is None else folder / FOLDER / f"{iteration:08d}"
    try:
        facts = json.loads((place / FACTS).read_text())
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{place}: damaged checkpoint: {FACTS} cannot be read") from error
    found = facts.get("schema") if isinstance(facts, dict) else None
    if found != SCHEMA:
        raise CheckpointError(f"{place / FACTS}: {other_schema(found, SCHEMA, 'train anew with `--overwrite`')}")
    try:
        restored = ocp.PyTreeCheckpointer().restore((place / ARRAYS).resolve())
        whole = {**restored, **{name: np.zeros(0, dtype) for name, dtype in facts["empty"].items()}}
        arrays = {name: np.asarray(whole[name]).reshape(shape) for name, shape in facts["shapes"].items()}
    except Exception as error:  # a truncated file surfaces as whatever the storage library makes of it
        raise CheckpointError(f"{place}: damaged checkpoint: its arrays cannot be read") from error
    if _digest(arrays) != facts.get("digest"):
        raise CheckpointError(f"{place}: damaged checkpoint: its arrays are not those that were written")
    return Stored(place, facts, arrays)


def has_checkpoint(run: Path) -> bool:
    """Returns True if a run folder holds a checkpoint."""
    return bool(_numbered(run / FOLDER))


def iterations(run: Path) -> list[int]:
    """Lists the iterations of which a run folder holds checkpoints, in order."""
    return [int(place.name) for place in _numbered(run / FOLDER)]


def _find(folder: Path) -> Path:
    if not folder.exists():
        raise CheckpointError(f"{folder}: no such folder")
    if (folder / FACTS).exists():
        return folder
    numbered = _numbered(folder / FOLDER) or _numbered(folder)
    if not numbered:
        raise CheckpointError(f"{folder}: holds no checkpoint")
    return numbered[-1]


def _numbered(folder: Path) -> list[Path]:
    return sorted((p for p in folder.glob("*") if p.name.isdigit()), key=lambda p: int(p.name))


def _place(name: str, path: Any) -> str:
    return f"{name}.{jax.tree_util.keystr(path, simple=True, separator='.')}"


def _digest(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype} {arrays[name].shape} ".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
