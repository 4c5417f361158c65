"""A run folder: refused before anything is compiled if it cannot be used, and filled by one run."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import jax

from subterra_jax.host.files import require_folder
from train import policies
from train.config import TrainConfig
from train.devices import cluster
from train.errors import CheckpointError, ConfigError, RunFolderError
from train.run import board, checkpoint
from train.run.episodes import Best, EpisodeWindow
from train.run.log import EPISODES, LOG, TABLE
from train.run.snapshot import Snapshot, Trainable

CONFIG = "config.json"
_FILES = (CONFIG, LOG, TABLE, EPISODES, "curve.png", "curve.csv", "evaluation.json")


class RunFolder:
    """The outputs of one training run.

    Args:
        path: The folder.
        world: What is trained on.
        learner: What is trained.

    Raises:
        OutputError: No folder can be written there.
    """

    def __init__(self, path: Path, world: policies.World, learner: Trainable) -> None:
        require_folder(path)
        self.path, self._world, self._learner = path, world, learner

    def begin(self, *, resume: bool, overwrite: bool) -> Snapshot | None:
        """The snapshot to go on from; None for a new run, for which the folder is then ready.

        Raises:
            RunFolderError: As `start`.
            CheckpointError: As `resume`.
            ConfigError: As `resume`.
        """
        if resume:
            return self.resume()
        if not cluster.leads():
            return None
        self.start(overwrite=overwrite)
        return None

    def start(self, *, overwrite: bool) -> None:
        """Makes the folder ready for a new run.

        Raises:
            RunFolderError: It holds a run already, and that may not be overwritten.
        """
        if any((self.path / name).exists() for name in _FILES) or checkpoint.exists(self.path):
            if not overwrite:
                raise RunFolderError(
                    f"{self.path}: holds a run already; --resume goes on with it, --overwrite replaces it"
                )
            for name in _FILES:
                (self.path / name).unlink(missing_ok=True)
            for name in (checkpoint.FOLDER, board.FOLDER):
                shutil.rmtree(self.path / name, ignore_errors=True)
        self.path.mkdir(parents=True, exist_ok=True)
        self._write_config()

    def resume(self, iteration: int | None = None) -> Snapshot:
        """The newest checkpoint of the folder, or that of an iteration.

        Raises:
            CheckpointError: There is none, it is damaged, or it is of another network.
            ConfigError: It was trained on something else or with other settings.
        """
        stored = checkpoint.load(self.path, iteration)
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
        if cluster.leads():
            self._write_config()
        return snapshot

    def save(self, snapshot: Snapshot) -> None:
        """Writes a checkpoint, from which the policy can be used and the run can go on."""
        score, state = snapshot.best.score, self._learner.gather(snapshot.state)
        if not cluster.leads():
            return
        checkpoint.save(
            self.path,
            snapshot.iteration,
            {"policy": snapshot.policy, "state": state},
            {
                "world": self._world.facts,
                "task": self._world.task,
                "kind": self._learner.networks.kind,
                "layout": dataclasses.asdict(self._learner.networks.layout),
                "config": _plain(self._learner.config),
                "iteration": snapshot.iteration,
                "best": {"success": score[0], "episode_return": score[1], "iteration": snapshot.best.iteration},
                "solved_for": snapshot.solved_for,
                "window": snapshot.window.to_json(),
            },
        )

    def write_json(self, name: str, values: dict[str, Any]) -> None:
        """Writes one JSON file, whole or not at all."""
        fresh = self.path / f".{name}.partial"
        fresh.write_text(json.dumps(values, indent=1) + "\n")
        fresh.replace(self.path / name)

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
                "versions": policies.versions(),
            },
        )


def _plain(config: TrainConfig) -> dict[str, Any]:
    return json.loads(json.dumps(dataclasses.asdict(config)))
