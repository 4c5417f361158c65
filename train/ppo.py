"""Training from start to end: `train` compiles one iteration, repeats it, and keeps the best policy.

The host only counts finished episodes and decides when to stop; what an iteration is stands in `learner.py`.
"""

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from train import compiling
from train.config import PPOConfig
from train.episodes import COLUMNS, Best, EpisodeWindow
from train.errors import TrainingError
from train.learner import Learner, Report, TrainState
from train.networks import Policy


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
    state: TrainState
    window: EpisodeWindow
    best: Best
    solved_for: int = 0
    record: dict[str, Any] = dataclasses.field(default_factory=dict)
    rows: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, COLUMNS))

    @property
    def policy(self) -> Policy:
        """The policy to keep."""
        return self.best.policy


Watcher = Callable[[Snapshot], bool | None]


def begin(learner: Learner, params: Any) -> Snapshot:
    """An untrained run."""
    state = jax.jit(learner.init, compiler_options=compiling.options())(jax.random.PRNGKey(learner.config.seed), params)
    window = EpisodeWindow()
    # A copy: the state's own arrays are given up to the next iteration.
    untrained = jax.tree.map(np.asarray, Policy(state.student.weights["policy"], state.statistics))
    return Snapshot(0, state, window, Best.of(None, window, 0, untrained))


def train(
    env: Any,
    params: Any,
    config: PPOConfig,
    *,
    learner: Learner | None = None,
    snapshot: Snapshot | None = None,
    watch: Watcher | None = None,
) -> Snapshot:
    """Trains until the goal has held for long enough, or the steps are used up.

    Args:
        env: A navigation environment, as `st.make` returns it.
        params: Its parameters.
        config: Settings.
        learner: Made of the same three; built here if left out.
        snapshot: Where to go on from; its state is used up. The beginning if left out.
        watch: Called after every iteration; training ends early if it returns True.

    Returns:
        The last snapshot. Its `policy` is the best one, which need not be the last.

    Raises:
        ConfigError: A setting makes no sense.
        TrainingError: The loss is no longer finite.
    """
    learner = learner or Learner(env, params, config)
    snapshot = snapshot or begin(learner, params)
    if snapshot.iteration >= config.iterations or _solved(snapshot, config):
        return snapshot
    began = time.perf_counter()
    iterate = jax.jit(learner.iterate, donate_argnums=0).lower(snapshot.state, params).compile(compiling.options())
    compile_seconds = time.perf_counter() - began
    while snapshot.iteration < config.iterations and not _solved(snapshot, config):
        before = time.perf_counter()
        state, report = iterate(snapshot.state, params)
        snapshot = _advance(snapshot, state, report, config)
        now = time.perf_counter()
        # Apart from this field, two runs of one seed log the same bytes.
        snapshot.record["timing"] = {
            "seconds": round(now - began, 3),
            "compile_seconds": round(compile_seconds, 3),
            "steps_per_second": round(config.steps_per_iteration / (now - before)),
        }
        if watch is not None and watch(snapshot):
            break
    return snapshot


def _solved(snapshot: Snapshot, config: PPOConfig) -> bool:
    return snapshot.solved_for >= config.stop_patience


def _advance(before: Snapshot, state: TrainState, report: Report, config: PPOConfig) -> Snapshot:
    """The snapshot after one iteration, read from the device."""
    finished, metrics = jax.device_get((report.finished, report.metrics))
    iteration, window = before.iteration + 1, before.window
    rows = window.add(finished, before.iteration * config.steps_per_iteration)
    broken = [name for name, value in metrics.items() if not math.isfinite(value)]
    if broken:
        raise TrainingError(f"iteration {iteration}: {broken[0]} is no longer finite; a smaller learning_rate may help")
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
        **{name: float(value) for name, value in sorted(metrics.items())},
    }
    return Snapshot(
        iteration=iteration,
        state=state,
        window=window,
        best=Best.of(before.best, window, iteration, report.policy),
        solved_for=before.solved_for + 1 if holds else 0,
        record=record,
        rows=rows,
    )
