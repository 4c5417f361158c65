"""A run folder: refused before compiling if it cannot be used, filled by one run, and gone on with after a kill."""

import dataclasses
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import jax

from subterra_jax.host.errors import SubterraError
from subterra_jax.host.files import replace_file, require_folder
from subterra_jax.policies.files import CHECKPOINT_POLICY, TENSORS
from train.checkpoint import (
    FOLDER,
    CheckpointError,
    has_checkpoint,
    iterations,
    load_checkpoint,
    remove_folder,
    save_checkpoint,
)
from train.config import ConfigError, TrainConfig
from train.log import EPISODES, LOG, TABLE
from train.policies import write_tensors
from train.sinks import TENSORBOARD
from train.snapshot import Best, EpisodeWindow, Snapshot, Trainable
from train.world import REWARD, World, library_versions

CONFIG, SCHEMA = "config.json", "subterra.run/1"


class RunFolderError(SubterraError):
    """The output folder cannot be written, or already holds something else."""


_FILES = (CONFIG, LOG, TABLE, EPISODES, "curve.png", "curve.csv", "evaluation.json")


class RunFolder:
    """The outputs of one training run.

    Args:
        path: The folder.
        world: World to train on.
        learner: Learner to train.
        command: Options of the command line, by name, with which `--config config.json` does the same again; None for a
            run from Python.

    Raises:
        OutputError: No folder can be written there.
    """

    def __init__(self, path: Path, world: World, learner: Trainable, command: dict[str, Any] | None = None) -> None:
        require_folder(path)
        self.path, self._world, self._learner, self._command = path, world, learner, command

    def begin(self, *, resume: bool, overwrite: bool) -> Snapshot | None:
        """Returns the snapshot to go on from; None for a run from its beginning, for which it makes the folder ready.

        Args:
            resume: Go on from the newest checkpoint; from the beginning where a kill came before the first one.
            overwrite: Throw away the run that the folder holds.

        Raises:
            RunFolderError: It holds a run already, and neither is needed.
            CheckpointError: As `resume`.
            ConfigError: As `resume`.
        """
        if resume and has_checkpoint(self.path):
            return self.resume()
        if resume:
            self._check_begun()
        elif not overwrite and self._holds_run():
            raise RunFolderError(f"{self.path}: holds a run already; --resume goes on with it, --overwrite replaces it")
        if resume:
            print(f"{self.path}: no checkpoint yet; begins at the beginning", file=sys.stderr)
        self.start()
        return None

    def start(self) -> None:
        """Makes the folder ready for a run from its beginning; what it holds of another run is thrown away."""
        # The checkpoints go first and at once: they are what a later --resume believes.
        remove_folder(self.path / FOLDER)
        for name in _FILES:
            (self.path / name).unlink(missing_ok=True)
        shutil.rmtree(self.path / TENSORBOARD, ignore_errors=True)
        self.path.mkdir(parents=True, exist_ok=True)
        self._write_config()

    def resume(self, iteration: int | None = None) -> Snapshot:
        """Reads the newest checkpoint of the folder, or that of an iteration.

        Raises:
            CheckpointError: There is none, it is damaged, or it is of another network.
            ConfigError: It was trained on something else or with other settings.
        """
        stored = load_checkpoint(self.path, iteration)
        facts = stored.facts
        self._check_same(facts["kind"], facts["world"], facts["config"])
        shapes = jax.eval_shape(self._learner.init, jax.random.PRNGKey(0), self._world.params)
        best = facts["best"]
        snapshot = Snapshot(
            iteration=facts["iteration"],
            state=self._learner.place(stored.restore("state", shapes)),
            window=EpisodeWindow.from_json(facts["window"]),
            best=Best(
                score=(best["success"], best["episode_return"]),
                iteration=best["iteration"],
                policy=stored.restore("policy", jax.eval_shape(self._learner.policy_of, shapes)),
            ),
            solved_for=facts["solved_for"],
        )
        self._write_config()
        return snapshot

    def _holds_run(self) -> bool:
        return any((self.path / name).exists() for name in _FILES) or has_checkpoint(self.path)

    def _check_begun(self) -> None:
        """Refuses to begin where another run was killed before its first checkpoint.

        Raises:
            CheckpointError: It was of another network.
            ConfigError: It was of something else, or its file cannot be read.
        """
        place = self.path / CONFIG
        if not place.exists():
            return
        try:
            saved = json.loads(place.read_text())
            kind, config = saved["kind"], saved["config"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{place}: cannot be read; --overwrite begins anew") from error
        self._check_same(kind, saved, config)

    def _check_same(self, kind: str, world: dict[str, Any], settings: dict[str, Any]) -> None:
        """Refuses a run of another network, on something else or with other settings.

        Raises:
            CheckpointError: It is of another network.
            ConfigError: It was trained on something else or with other settings.
        """
        if kind != self._learner.driver.kind:
            raise CheckpointError(f"{self.path}: made for another network: {kind}, not {self._learner.driver.kind}")
        config = _plain(self._learner.config)
        was = f"{self.path}: was trained with"
        for name in sorted({REWARD, *self._world.facts}):
            if world.get(name) != self._world.facts.get(name):
                raise ConfigError(f"{was} {name} = {world.get(name)}, not {self._world.facts.get(name)}")
        for name, value in config.items():
            if name not in self._learner.config.LIMITS and settings.get(name) != value:
                raise ConfigError(f"{was} {name} = {settings.get(name)}, not {value}")
        for name in settings.keys() - config.keys():
            raise ConfigError(f"{was} {name} = {settings[name]}, this run has no {name}")

    def save(self, snapshot: Snapshot) -> None:
        """Writes a checkpoint, from which the policy can be used and the run can go on."""
        score, state = snapshot.best.score, self._learner.gather(snapshot.state)
        driver = self._learner.driver
        tensors = driver.tensors(snapshot.policy)
        facts = {
            "world": self._world.facts,
            "task": self._world.task,
            "config": _plain(self._learner.config),
            **self._world.trained_under,
            "iteration": snapshot.iteration,
        }
        save_checkpoint(
            self.path,
            snapshot.iteration,
            {"policy": snapshot.policy, "state": state},
            {
                **facts,
                "kind": driver.kind,
                "layout": driver.layout.to_json(),
                "best": {"success": score[0], "episode_return": score[1], "iteration": snapshot.best.iteration},
                "solved_for": snapshot.solved_for,
                "window": snapshot.window.to_json(),
            },
            lambda place: write_tensors(
                place / f"{CHECKPOINT_POLICY}{TENSORS}", driver.kind, driver.layout, tensors, facts
            ),
        )

    def has(self, iteration: int) -> bool:
        """Returns True where the newest checkpoint is that of an iteration."""
        return iterations(self.path)[-1:] == [iteration]

    def write_json(self, name: str, values: dict[str, Any]) -> None:
        """Writes one JSON file, whole or not at all."""
        with replace_file(self.path / name) as fresh:
            fresh.write_text(json.dumps(values, indent=1) + "\n")

    def _write_config(self) -> None:
        device = jax.devices()[0]
        self.write_json(
            CONFIG,
            {
                "schema": SCHEMA,
                **self._world.facts,
                "kind": self._learner.driver.kind,
                "config": _plain(self._learner.config),
                **({} if self._command is None else {"command": self._command}),
                "device": f"{device.platform}: {device.device_kind}",
                "versions": library_versions(),
            },
        )


def _plain(config: TrainConfig) -> dict[str, Any]:
    return json.loads(json.dumps(dataclasses.asdict(config)))
