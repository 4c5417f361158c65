"""The host's side of one run of walking: what is scored, drawn and released."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib
import numpy as np

from subterra_jax.b2.gait import WalkPolicy
from train import cli, release
from train.agents import tensors_of
from train.b2.score import score, walker
from train.policies import versions
from train.run.log import LOG
from train.run.session import EVALUATION, Session
from train.run.snapshot import Snapshot

FIGURE = "curve.png"


class WalkSession(Session):
    """As `Session`, for a gait."""

    def score(self, snapshot: Snapshot, robots: int) -> dict[str, Any]:
        """Evaluates the policy and the bare trot, writes `evaluation.json`, and prints the scores."""
        env = dataclasses.replace(self.world.env, privileged=False)
        params, period = self.world.params, env.physics.period
        go = walker(env, self.policy(snapshot).act, robots, int(params.horizon))
        # Offsets of nothing leave the trot as it is.
        bare = dataclasses.replace(params, action_scale=jnp.zeros(3))
        found = {name: score(go(given), period) for name, given in (("policy", params), ("trot", bare))}
        self.folder.write_json(EVALUATION, {"schema": "subterra.evaluation/1", **self.world.facts, **found})
        told = {f"{name}, {who}": value for who, figures in found.items() for name, value in figures.items()}
        cli.table(f"{self.world.task}, seed {self.learner.config.seed}: without exploration noise", told)
        return found

    def policy(self, snapshot: Snapshot) -> WalkPolicy:
        """The policy as the package loads it."""
        return WalkPolicy({name: jnp.asarray(tensor) for name, tensor in self._tensors(snapshot).items()})

    def release(self, out: Path, snapshot: Snapshot, found: dict[str, Any]) -> None:
        """Writes the policy and its facts."""
        config, networks = self.learner.config, self.learner.networks
        facts = {
            "task": self.world.task,
            "world": self.world.facts,
            "config": json.loads(json.dumps(dataclasses.asdict(config))),
            "iteration": snapshot.iteration,
            "steps": snapshot.iteration * config.steps_per_iteration,
            "versions": versions(),
            "scores": {**self.world.facts, **found},
        }
        release.write(out, networks, networks.tensors(snapshot.policy), facts)
        print(out)

    def finish(self, snapshot: Snapshot) -> None:
        """Writes the last checkpoint and the curve."""
        self.folder.save(snapshot)
        draw(self.folder.path)

    def _tensors(self, snapshot: Snapshot) -> dict[str, np.ndarray]:
        networks = self.learner.networks
        return tensors_of(networks, networks.tensors(snapshot.policy))


def draw(run: Path) -> None:
    """Draws a run's rewards and the length of its episodes against steps, `curve.png`."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    records = [json.loads(line) for line in (run / LOG).read_text().splitlines()]
    steps = [record["step"] / 1e6 for record in records]
    first = records[0] if records else {}
    names = sorted(name for name in first if name.startswith("reward_") and name != "reward_scale")
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4), layout="constrained")
    colours = pyplot.get_cmap("tab20")(np.arange(len(names)))  # there are more terms than usual colours
    for name, colour in zip(names, colours, strict=True):
        left.plot(
            steps,
            [record[name] * 50.0 for record in records],
            label=name.removeprefix("reward_"),
            color=colour,
            linewidth=1,
        )
    right.plot(steps, [record["length_mean_100"] for record in records], linewidth=1)
    left.set(xlabel="control periods, millions", ylabel="reward a second")
    right.set(xlabel="control periods, millions", ylabel="length of the last 100 episodes")
    left.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(run / FIGURE, dpi=110, metadata={"Software": None})
    pyplot.close(figure)
