"""Finished episodes on the host: in order of finishing, the last hundred of them, and the best policy so far."""

import dataclasses
from typing import Any

import numpy as np

from train.run.report import Ended

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
        """Whether there are a hundred episodes yet."""
        return len(self.last) == WINDOW

    def mean(self, name: str) -> float | None:
        """Mean of one column over the window; `None` before the first episode has finished."""
        return float(self.last[name].mean(dtype=np.float64)) if len(self.last) else None

    def to_json(self) -> dict[str, Any]:
        """Everything needed to go on counting, as plain values that JSON keeps exactly."""
        return {"count": self.count, **{name: self.last[name].tolist() for name in COLUMNS.names or ()}}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "EpisodeWindow":
        """The inverse of `to_json`."""
        last = np.zeros(len(values["episode"]), COLUMNS)
        for name in COLUMNS.names or ():
            last[name] = values[name]
        return cls(values["count"], last)


@dataclasses.dataclass(frozen=True)
class Best:
    """The policy whose rolling hundred did best: by success first, then by return.

    Attributes:
        score: Mean success and mean return of the hundred episodes.
        iteration: The iteration that ended with them.
        policy: The policy that drove that iteration.
    """

    score: tuple[float, float]
    iteration: int
    policy: Any

    @staticmethod
    def of(best: "Best | None", window: EpisodeWindow, iteration: int, policy: Any, *, keep: bool = True) -> "Best":
        """The better one of `best` and the policy that has just driven; before a hundred episodes, the latter.

        Without `keep` always the latter: where a task becomes harder while it is learnt, scores do not compare.
        """
        # An unfinished hundred scores below every finished one, so that a lucky first episode wins nothing.
        score = (window.mean("success") or 0.0, window.mean("episode_return") or 0.0) if window.full else (-1.0, 0.0)
        return best if keep and best is not None and best.score > score else Best(score, iteration, policy)
