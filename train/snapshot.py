"""A run between two iterations: finished episodes, the best policy so far, and the step from one to the next."""

import dataclasses
import math
import time
from typing import Any, Protocol

import jax
import numpy as np

from subterra_jax.host.command import EXIT_FAILED
from subterra_jax.host.errors import SubterraError
from train.config import TrainConfig
from train.report import Ended, Report

WINDOW = 100
COLUMNS = np.dtype(
    [
        ("episode", np.int64),
        ("step", np.int64),
        ("coverage", np.float32),
        ("success", np.bool_),
        ("length", np.int64),
        ("episode_return", np.float32),
        ("contact", np.bool_),
    ]
)


class TrainingError(SubterraError):
    """Training came to a point from which it cannot go on."""

    exit_status = EXIT_FAILED


class RewardError(SubterraError):
    """The reward of a task is infinite or no number."""


class EpisodeWindow:
    """The last hundred finished episodes.

    Episodes that finish in the same control period are ordered by the index of their environment.

    Attributes:
        count: Episodes finished since the run began.
        last: The last of them, oldest first, at most a hundred rows of `COLUMNS`.
    """

    def __init__(self, count: int = 0, last: np.ndarray | None = None) -> None:
        self.count = count
        self.last = np.zeros(0, COLUMNS) if last is None else last

    def add(self, ended: Ended, step: int, n_envs: int) -> np.ndarray:
        """Takes in one unroll.

        Args:
            ended: The unroll's episodes, on the host.
            step: Environment steps before the unroll, all environments together.
            n_envs: Environments stepped together.

        Returns:
            The new rows of `COLUMNS`: `episode` counts from 1; `step` is the number of environment steps, all
            environments together, at the end of the control period in which the episode finished.
        """
        rows = np.zeros(len(ended.index), COLUMNS)
        rows["episode"] = self.count + 1 + np.arange(len(rows))
        rows["step"] = step + (ended.index // n_envs + 1) * n_envs
        for name in ("coverage", "success", "length", "episode_return", "contact"):
            rows[name] = getattr(ended, name)
        self.count += len(rows)
        self.last = np.concatenate([self.last, rows])[-WINDOW:]
        return rows

    @property
    def full(self) -> bool:
        """True once there are a hundred episodes."""
        return len(self.last) == WINDOW

    def mean(self, name: str) -> float | None:
        """Averages one column over the window; `None` before the first episode has finished."""
        return float(self.last[name].mean(dtype=np.float64)) if len(self.last) else None

    def to_json(self) -> dict[str, Any]:
        """Returns all that counting on needs, as plain values that JSON keeps exactly."""
        return {"count": self.count, **{name: self.last[name].tolist() for name in COLUMNS.names or ()}}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "EpisodeWindow":
        """Reads the result of `to_json`."""
        last = np.zeros(len(values["episode"]), COLUMNS)
        for name in COLUMNS.names or ():
            last[name] = values[name]
        return cls(values["count"], last)


@dataclasses.dataclass(frozen=True)
class Best:
    """The last policy that did as well as any before it, as far as a hundred episodes tell."""

    score: tuple[float, float]  # mean success of the best hundred episodes, and their mean return
    iteration: int  # the iteration of the policy
    policy: Any  # the policy that drove that iteration

    @staticmethod
    def of(best: "Best | None", window: EpisodeWindow, iteration: int, policy: Any, *, keep: bool = True) -> "Best":
        """Returns the policy that has just driven, or `best` where that did better by three standard errors.

        The luckiest of many hundreds is no better than those after it. Without `keep` it is always the former: where a
        task becomes harder while it is learnt, scores do not compare.
        """
        # An unfinished hundred scores below every finished one, so that a lucky first episode wins nothing.
        score = (window.mean("success") or 0.0, window.mean("episode_return") or 0.0) if window.full else (-1.0, 0.0)
        if best is None or not keep or best.score[0] < 0.0:
            return Best(score, iteration, policy)
        middle = 0.5 * (score[0] + best.score[0])
        if best.score[0] - score[0] > 3.0 * math.sqrt(2.0 * middle * (1.0 - middle) / WINDOW):
            return best
        return Best(max(score, best.score), iteration, policy)


class Trainable(Protocol):
    """A learner of any kind."""

    driver: Any  # with `kind` and `layout`

    @property
    def config(self) -> Any:
        """A `TrainConfig`."""

    def init(self, key: Any, params: Any) -> Any:
        """Returns the state of an untrained run."""

    def iterate(self, state: Any, params: Any) -> tuple[Any, Report]:
        """Runs one iteration."""

    def policy_of(self, state: Any) -> Any:
        """Returns the policy in a state."""

    def place(self, state: Any) -> Any:
        """Puts a state from a checkpoint on its devices."""

    def share(self, tree: Any) -> Any:
        """Puts data that every part reads on its devices."""

    def gather(self, state: Any) -> Any:
        """Fetches a state for a checkpoint."""


@dataclasses.dataclass
class Snapshot:
    """A run between two iterations. With the same config it goes on exactly as if it had never stopped."""

    iteration: int  # iterations done
    state: Any  # everything on the device
    window: EpisodeWindow  # finished episodes
    best: Best  # the best policy so far
    solved_for: int = 0  # iterations in a row in which the goal held
    # log line of the last iteration; empty before the first
    record: dict[str, Any] = dataclasses.field(default_factory=dict)
    # the episodes that finished in it, rows of `episodes.COLUMNS`
    rows: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, COLUMNS))

    @property
    def policy(self) -> Any:
        """The policy to keep."""
        return self.best.policy


def started(learner: Trainable, state: Any) -> Snapshot:
    """Makes the snapshot of an untrained run from its state."""
    window = EpisodeWindow()
    # A copy: the state's own arrays are given up to the next iteration.
    untrained = jax.tree.map(np.asarray, learner.policy_of(state))
    return Snapshot(0, state, window, Best.of(None, window, 0, untrained))


def finished(snapshot: Snapshot, config: TrainConfig) -> bool:
    """Returns True once a run has come to its end."""
    return snapshot.iteration >= config.iterations or snapshot.solved_for >= config.stop_patience


def timing(began: float, compiled: float, before: float, steps: int) -> dict[str, Any]:
    """Measures the times of an iteration, the one field of the log that differs between two runs of one seed.

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
    """Makes the snapshot after one iteration.

    Args:
        before: The one before; its window is moved on.
        state: Everything on the device.
        policy: The one that drove.
        ended: Episodes that ended, on the host.
        metrics: Scalars, on the host.
        config: Settings.

    Raises:
        RewardError: The reward is not finite.
        TrainingError: Another scalar is no longer finite.
    """
    iteration, window = before.iteration + 1, before.window
    if broken := [name for name, value in metrics.items() if not math.isfinite(value)]:
        _refuse(iteration, broken)
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


def _refuse(iteration: int, broken: list[str]) -> None:
    """Raises the error of an iteration some of whose scalars are not finite."""
    if "reward_mean" not in broken:
        raise TrainingError(
            f"iteration {iteration}: {', '.join(broken)} {'is' if len(broken) == 1 else 'are'} no longer finite; "
            "the last checkpoint is good, and a smaller learning_rate may help"
        )
    terms = [name for name in broken if name.startswith("reward_") and name not in ("reward_mean", "reward_scale")]
    raise RewardError(
        f"iteration {iteration}: the task's reward is not finite ({', '.join(terms) or 'no single term'}); "
        "a policy learns from finite rewards alone"
    )
