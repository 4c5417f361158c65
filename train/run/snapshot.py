"""A run between two iterations, and what leads from one to the next."""

import dataclasses
import math
import time
from typing import Any, Protocol

import jax
import numpy as np

from train.config import TrainConfig
from train.errors import TrainingError
from train.run.episodes import COLUMNS, Best, EpisodeWindow
from train.run.report import Ended, Report


class Trainable(Protocol):
    """What can be trained here: `Learner`, or `recurrent.learner.RecurrentLearner`.

    Attributes:
        networks: With `kind`, `layout` and `policy_shapes`.
    """

    networks: Any

    @property
    def config(self) -> Any:
        """A `TrainConfig`."""

    def init(self, key: Any, params: Any) -> Any:
        """The state of an untrained run."""

    def iterate(self, state: Any, params: Any) -> tuple[Any, Report]:
        """One iteration."""

    def policy_of(self, state: Any) -> Any:
        """The policy in a state."""

    def place(self, state: Any) -> Any:
        """A state that was read from a checkpoint, where it belongs."""

    def share(self, tree: Any) -> Any:
        """What every part of it reads, where it belongs."""

    def gather(self, state: Any) -> Any:
        """A state as a checkpoint holds it."""


@dataclasses.dataclass
class Snapshot:
    """A run between two iterations. With the same config it goes on exactly as if it had never stopped.

    Attributes:
        iteration: Iterations done.
        state: Everything on the device.
        window: Finished episodes.
        best: The best policy so far.
        solved_for: Iterations in a row in which the goal held.
        record: What is to be logged of the last iteration; empty before the first.
        rows: The episodes that finished in it, rows of `episodes.COLUMNS`.
    """

    iteration: int
    state: Any
    window: EpisodeWindow
    best: Best
    solved_for: int = 0
    record: dict[str, Any] = dataclasses.field(default_factory=dict)
    rows: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, COLUMNS))

    @property
    def policy(self) -> Any:
        """The policy to keep."""
        return self.best.policy


def started(learner: Trainable, state: Any) -> Snapshot:
    """An untrained run from its state."""
    window = EpisodeWindow()
    # A copy: the state's own arrays are given up to the next iteration.
    untrained = jax.tree.map(np.asarray, learner.policy_of(state))
    return Snapshot(0, state, window, Best.of(None, window, 0, untrained))


def finished(snapshot: Snapshot, config: TrainConfig) -> bool:
    """Whether a run has come to its end."""
    return snapshot.iteration >= config.iterations or snapshot.solved_for >= config.stop_patience


def timing(began: float, compiled: float, before: float, steps: int) -> dict[str, Any]:
    """The one field in which two runs of one seed log something else.

    Args:
        began: When the run, or this part of it, began to compile, s.
        compiled: When it had compiled.
        before: When the iteration began.
        steps: Environment steps in it.
    """
    now = time.perf_counter()
    return {
        "seconds": round(now - began, 3),
        "compile_seconds": round(compiled - began, 3),
        "steps_per_second": round(steps / (now - before)),
    }


def advance(
    before: Snapshot, state: Any, policy: Any, ended: Ended, metrics: dict[str, np.ndarray], config: TrainConfig
) -> Snapshot:
    """The snapshot after one iteration.

    Args:
        before: The one before; its window is moved on.
        state: Everything on the device.
        policy: The one that drove.
        ended: Episodes that ended, on the host.
        metrics: Scalars, on the host.
        config: Settings.

    Raises:
        TrainingError: A scalar is no longer finite.
    """
    iteration, window = before.iteration + 1, before.window
    if broken := [name for name, value in metrics.items() if not math.isfinite(value)]:
        raise TrainingError(
            f"iteration {iteration}: {', '.join(broken)} {'is' if len(broken) == 1 else 'are'} no longer finite; "
            "the last checkpoint is good, and a smaller learning_rate may help"
        )
    rows = window.add(ended, before.iteration * config.steps_per_iteration, config.n_envs)
    coverage, success = window.mean("coverage"), window.mean("success")
    holds = window.full and (coverage or 0.0) >= config.stop_coverage and success == 1.0
    record = {
        "iteration": iteration,
        "step": iteration * config.steps_per_iteration,
        "episodes": window.count,
        "coverage_mean_100": coverage,
        "success_mean_100": success,
        "return_mean_100": window.mean("episode_return"),
        "length_mean_100": window.mean("length"),
        "finished": len(rows),
        "finished_success": float(rows["success"].mean()) if len(rows) else None,
        "finished_contact": float(rows["contact"].mean()) if len(rows) else None,
        **{name: float(value) for name, value in sorted(metrics.items())},
    }
    return Snapshot(
        iteration=iteration,
        state=state,
        window=window,
        best=Best.of(before.best, window, iteration, policy, keep=config.KEEPS_BEST),
        solved_for=before.solved_for + 1 if holds else 0,
        record=record,
        rows=rows,
    )
