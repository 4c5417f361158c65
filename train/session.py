"""The host's side of one run: its folder, its log, its checkpoints, its curve and its evaluation."""

from pathlib import Path
from typing import Any

from subterra_jax.evaluation.episodes import SHA256
from train import cli, cluster, curve, ppo
from train.agents import agent_of
from train.evaluate import evaluate
from train.log import RunLog
from train.policies import World
from train.runfolder import RunFolder

EVALUATION = "evaluation.json"


class Session:
    """One run, from the command to its figures.

    Args:
        path: Run folder.
        world: What is trained on.
        learner: What is trained.
    """

    def __init__(self, path: Path, world: World, learner: ppo.Trainable) -> None:
        self.folder, self.world, self.learner = RunFolder(path, world, learner), world, learner
        self.log: RunLog | None = None

    def open(self, snapshot: ppo.Snapshot | None) -> None:
        """Begins to log, after a snapshot or from the beginning."""
        iteration, episodes = (snapshot.iteration, snapshot.window.count) if snapshot else (0, 0)
        if cluster.leads():
            self.log = RunLog(self.folder.path, iteration, episodes)

    def note(self, now: ppo.Snapshot, *, save: bool = False) -> None:
        """Logs an iteration; writes a checkpoint where one is due, or asked for."""
        if self.log is not None:
            self.log.write(now.record, now.rows)
        if save or now.iteration % self.learner.config.checkpoint_every == 0:
            self.folder.save(now)

    def close(self) -> None:
        """Closes the log."""
        if self.log is not None:
            self.log.close()
            self.log = None

    def finish(self, snapshot: ppo.Snapshot) -> None:
        """Writes the last checkpoint and the curve."""
        self.folder.save(snapshot)
        if not cluster.leads():
            return
        curve.write_curve([self.folder.path], self.folder.path / "curve.png")

    def score(self, snapshot: ppo.Snapshot, episodes: int) -> dict[str, Any]:
        """Evaluates the policy that was kept, writes `evaluation.json`, and prints the scores."""
        agent = agent_of(self.learner.networks, snapshot.policy)
        found = evaluate(self.world, agent, episodes)
        self.folder.write_json(EVALUATION, {"schema": "subterra.evaluation/1", **self.world.facts, **found})
        kept = "best" if self.learner.config.KEEPS_BEST else "last"
        told = {name: value for name, value in found.items() if value is not None and value != SHA256}
        cli.table(f"{self.world.task}, seed {self.learner.config.seed}: {kept} policy, no exploration noise", told)
        return found
