"""The host's side of one run: its folder, its log, its checkpoints, its curve and its evaluation."""

from pathlib import Path
from typing import Any

from subterra_jax.evaluation.episodes import SHA256
from train import cli, curve
from train.agents import agent_of
from train.devices import cluster
from train.evaluate import evaluate
from train.policies import World
from train.run import board
from train.run.folder import RunFolder
from train.run.log import RunLog
from train.run.snapshot import Snapshot, Trainable

EVALUATION = "evaluation.json"


class Session:
    """One run, from the command to its figures.

    Args:
        path: Run folder.
        world: What is trained on.
        learner: What is trained.
        tensorboard: Write the log for TensorBoard as well.

    Raises:
        ConfigError: What writes it is not installed.
        RunFolderError: No folder can be written there.
    """

    def __init__(self, path: Path, world: World, learner: Trainable, *, tensorboard: bool = False) -> None:
        self.folder, self.world, self.learner = RunFolder(path, world, learner), world, learner
        self.log: RunLog | None = None
        self.board: board.Board | None = None
        self._tensorboard = tensorboard
        if tensorboard:
            board.check()

    def open(self, snapshot: Snapshot | None) -> None:
        """Begins to log, after a snapshot or from the beginning."""
        iteration, episodes = (snapshot.iteration, snapshot.window.count) if snapshot else (0, 0)
        if cluster.leads():
            self.log = RunLog(self.folder.path, iteration, episodes)
            if self._tensorboard:
                self.board = board.Board(self.folder.path, iteration * self.learner.config.steps_per_iteration)

    def note(self, now: Snapshot, *, save: bool = False) -> None:
        """Logs an iteration; writes a checkpoint where one is due, or asked for."""
        if self.log is not None:
            self.log.write(now.record, now.rows)
        if self.board is not None:
            self.board.write(now.record)
        if save or now.iteration % self.learner.config.checkpoint_every == 0:
            self.folder.save(now)

    def close(self) -> None:
        """Closes the log."""
        for open_log in (self.log, self.board):
            if open_log is not None:
                open_log.close()
        self.log = self.board = None

    def finish(self, snapshot: Snapshot) -> None:
        """Writes the last checkpoint and the curve."""
        self.folder.save(snapshot)
        if not cluster.leads():
            return
        curve.write_curve([self.folder.path], self.folder.path / "curve.png")

    def score(self, snapshot: Snapshot, episodes: int) -> dict[str, Any]:
        """Evaluates the policy that was kept, writes `evaluation.json`, and prints the scores."""
        agent = agent_of(self.learner.networks, snapshot.policy)
        found = evaluate(self.world, agent, episodes)
        self.folder.write_json(EVALUATION, {"schema": "subterra.evaluation/1", **self.world.facts, **found})
        kept = "best" if self.learner.config.KEEPS_BEST else "last"
        told = {name: value for name, value in found.items() if value is not None and value != SHA256}
        cli.table(f"{self.world.task}, seed {self.learner.config.seed}: {kept} policy, no exploration noise", told)
        return found
