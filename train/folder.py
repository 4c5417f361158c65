"""A run folder: refused before compiling if it cannot be used, then filled by one run.

It holds `checkpoint/<iteration>/`: arrays by Orbax, everything else in one JSON file beside them. Each is
written under a temporary name and renamed, so that a kill at any moment leaves the one before it whole. A digest of all
arrays is kept in the JSON file: a damaged array is an error, never a policy.
"""

import dataclasses
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from subterra_jax.host.errors import SubterraError
from subterra_jax.host.files import replace_file, require_folder
from subterra_jax.host.versions import other_schema
from subterra_jax.policies import TRAINED_UNDER, training_conditions
from train import devices
from train.config import ConfigError, TrainConfig
from train.log import EPISODES, LOG, TABLE, TENSORBOARD
from train.snapshot import Best, EpisodeWindow, Snapshot, Trainable
from train.world import World, library_versions

SCHEMA = "subterra.checkpoint/1"
FOLDER, FACTS, ARRAYS = "checkpoint", "checkpoint.json", "arrays"
_KEPT = 2


class CheckpointError(SubterraError):
    """A checkpoint is missing, damaged, or belongs to another network or run."""


class RunFolderError(SubterraError):
    """The output folder cannot be written, or already holds something else."""


@dataclasses.dataclass(frozen=True)
class Stored:
    """A checkpoint as read: checked against its digest, not yet against any network.

    Attributes:
        path: Folder of the checkpoint.
        facts: The JSON file.
        arrays: Every array, by the name of its place.
    """

    path: Path
    facts: dict[str, Any]
    arrays: dict[str, np.ndarray]

    def restore(self, name: str, like: Any) -> Any:
        """Restores one of the trees that were saved.

        Args:
            name: Name that it was saved under.
            like: A tree of the same structure, its leaves of the shapes and types wanted, as from `jax.eval_shape`.

        Raises:
            CheckpointError: An array is missing, or of another shape or type.
        """
        paths, structure = jax.tree_util.tree_flatten_with_path(like)
        leaves = []
        for path, wanted in paths:
            place = _place(name, path)
            if place not in self.arrays:
                raise CheckpointError(f"{self.path}: has no {place}; it was made for another network")
            leaf = self.arrays[place]
            if leaf.shape != wanted.shape or leaf.dtype != wanted.dtype:
                raise CheckpointError(
                    f"{self.path}: made for another network: {place} is {leaf.dtype}{list(leaf.shape)}, "
                    f"this one needs {wanted.dtype}{list(wanted.shape)}"
                )
            leaves.append(leaf)
        return jax.tree.unflatten(structure, leaves)


def save_checkpoint(run: Path, iteration: int, trees: dict[str, Any], facts: dict[str, Any]) -> Path:
    """Writes `run/checkpoint/<iteration>` and forgets all but the last two.

    Args:
        run: The run folder.
        iteration: Names the checkpoint.
        trees: Pytrees of arrays, by name.
        facts: Values that JSON can hold; `schema` and `digest` are added.

    Returns:
        Where it is.
    """
    arrays = {
        _place(name, path): np.asarray(leaf)
        for name, tree in trees.items()
        for path, leaf in jax.tree_util.tree_flatten_with_path(jax.device_get(tree))[0]
    }
    place = run / FOLDER / f"{iteration:08d}"
    fresh = place.with_name(f".{place.name}.partial")
    for leftover in (fresh, place):  # `place` exists only where a resumed run passes it again
        shutil.rmtree(leftover, ignore_errors=True)
    fresh.mkdir(parents=True)
    # At least one axis each: Orbax gives scalars back as Python numbers.
    _arrays_file().save((fresh / ARRAYS).resolve(), {k: np.atleast_1d(v) for k, v in arrays.items()})
    shapes = {name: list(array.shape) for name, array in arrays.items()}
    whole = {"schema": SCHEMA, **facts, "shapes": shapes, "digest": _digest(arrays)}
    (fresh / FACTS).write_text(json.dumps(whole, indent=1) + "\n")
    fresh.rename(place)
    for old in _numbered(run / FOLDER)[:-_KEPT]:
        shutil.rmtree(old)
    return place


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
        restored = _arrays_file().restore((place / ARRAYS).resolve())
        arrays = {name: np.asarray(restored[name]).reshape(shape) for name, shape in facts["shapes"].items()}
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


def _arrays_file() -> ocp.Checkpointer:
    """Orbax for this process alone: of several that train together, others neither write nor wait for it."""
    me = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(
        primary_host=me, active_processes={me}, barrier_sync_key_prefix=f"process{me}"
    )
    return ocp.Checkpointer(ocp.PyTreeCheckpointHandler(multiprocessing_options=alone), multiprocessing_options=alone)


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


CONFIG = "config.json"
_FILES = (CONFIG, LOG, TABLE, EPISODES, "curve.png", "curve.csv", "evaluation.json")


class RunFolder:
    """The outputs of one training run.

    Args:
        path: The folder.
        world: World to train on.
        learner: Learner to train.

    Raises:
        OutputError: No folder can be written there.
    """

    def __init__(self, path: Path, world: World, learner: Trainable) -> None:
        require_folder(path)
        self.path, self._world, self._learner = path, world, learner

    def begin(self, *, resume: bool, overwrite: bool) -> Snapshot | None:
        """Returns the snapshot to go on from; None for a new run, for which it makes the folder ready.

        Raises:
            RunFolderError: As `start`.
            CheckpointError: As `resume`.
            ConfigError: As `resume`.
        """
        if resume:
            return self.resume()
        if not devices.leads():
            return None
        self.start(overwrite=overwrite)
        return None

    def start(self, *, overwrite: bool) -> None:
        """Makes the folder ready for a new run.

        Raises:
            RunFolderError: It holds a run already, and that may not be overwritten.
        """
        if any((self.path / name).exists() for name in _FILES) or has_checkpoint(self.path):
            if not overwrite:
                raise RunFolderError(
                    f"{self.path}: holds a run already; --resume goes on with it, --overwrite replaces it"
                )
            for name in _FILES:
                (self.path / name).unlink(missing_ok=True)
            for name in (FOLDER, TENSORBOARD):
                shutil.rmtree(self.path / name, ignore_errors=True)
        self.path.mkdir(parents=True, exist_ok=True)
        self._write_config()

    def resume(self, iteration: int | None = None) -> Snapshot:
        """Reads the newest checkpoint of the folder, or that of an iteration.

        Raises:
            CheckpointError: There is none, it is damaged, or it is of another network.
            ConfigError: It was trained on something else or with other settings.
        """
        stored = load_checkpoint(self.path, iteration)
        config, facts = self._learner.config, stored.facts
        if facts.get("kind", "mlp") != self._learner.networks.kind:
            raise CheckpointError(
                f"{self.path}: made for another network: {facts.get('kind', 'mlp')}, not {self._learner.networks.kind}"
            )
        for name, value in self._world.facts.items():
            if facts["world"].get(name) != value:
                raise ConfigError(f"{self.path}: was trained with {name} = {facts['world'].get(name)}, not {value}")
        for name, value in _plain(config).items():
            if name not in config.LIMITS and facts["config"].get(name) != value:
                raise ConfigError(f"{self.path}: was trained with {name} = {facts['config'].get(name)}, not {value}")
        for name in facts["config"].keys() - _plain(config).keys():
            raise ConfigError(f"{self.path}: was trained with {name} = {facts['config'][name]}, this run has no {name}")
        shapes = jax.eval_shape(self._learner.init, jax.random.PRNGKey(0), self._world.params)
        best = facts["best"]
        snapshot = Snapshot(
            iteration=facts["iteration"],
            state=self._learner.place(stored.restore("state", shapes)),
            window=EpisodeWindow.from_json(facts["window"]),
            best=Best(
                score=(best["success"], best["episode_return"]),
                iteration=best["iteration"],
                policy=stored.restore("policy", self._learner.networks.policy_shapes()),
            ),
            solved_for=facts["solved_for"],
        )
        if devices.leads():
            self._write_config()
        return snapshot

    def save(self, snapshot: Snapshot) -> None:
        """Writes a checkpoint, from which the policy can be used and the run can go on."""
        score, state = snapshot.best.score, self._learner.gather(snapshot.state)
        if not devices.leads():
            return
        save_checkpoint(
            self.path,
            snapshot.iteration,
            {"policy": snapshot.policy, "state": state},
            {
                "world": self._world.facts,
                "task": self._world.task,
                "kind": self._learner.networks.kind,
                "layout": dataclasses.asdict(self._learner.networks.layout),
                "config": _plain(self._learner.config),
                TRAINED_UNDER: training_conditions(self._world.env, self._world.params).to_json(),
                "iteration": snapshot.iteration,
                "best": {"success": score[0], "episode_return": score[1], "iteration": snapshot.best.iteration},
                "solved_for": snapshot.solved_for,
                "window": snapshot.window.to_json(),
            },
        )

    def write_json(self, name: str, values: dict[str, Any]) -> None:
        """Writes one JSON file, whole or not at all."""
        with replace_file(self.path / name) as fresh:
            fresh.write_text(json.dumps(values, indent=1) + "\n")

    def _write_config(self) -> None:
        device = jax.devices()[0]
        self.write_json(
            CONFIG,
            {
                "schema": "subterra.run/1",
                **self._world.facts,
                "kind": self._learner.networks.kind,
                "config": _plain(self._learner.config),
                "device": f"{device.platform}: {device.device_kind}",
                "versions": library_versions(),
            },
        )


def _plain(config: TrainConfig) -> dict[str, Any]:
    return json.loads(json.dumps(dataclasses.asdict(config)))
