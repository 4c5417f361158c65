"""Training from start to end: `train` compiles one iteration, repeats it, and keeps the best policy.

The host only counts finished episodes and decides when to stop; what an iteration is stands in `learner.py`, and in
`recurrent/learner.py` and `recurrent/distill.py` for networks with memory.
"""

import time
from collections.abc import Callable
from typing import Any

import jax

from train.config import PPOConfig, TrainConfig
from train.devices import compiling
from train.feedforward.learner import Learner
from train.run.fetching import fetch
from train.run.snapshot import Snapshot, Trainable, advance, finished, started, timing

Watcher = Callable[[Snapshot], bool | None]


def begin(learner: Trainable, params: Any) -> Snapshot:
    """An untrained run."""
    key = learner.share(jax.random.PRNGKey(learner.config.seed))
    state = jax.jit(learner.init, compiler_options=compiling.options())(key, learner.share(params))
    return started(learner, state)


def train(
    env: Any,
    params: Any,
    config: TrainConfig,
    *,
    learner: Trainable | None = None,
    snapshot: Snapshot | None = None,
    watch: Watcher | None = None,
    deterministic: bool = True,
) -> Snapshot:
    """Trains until the goal has held for long enough, or the steps are used up.

    Args:
        env: A navigation environment, as `st.make` returns it.
        params: Its parameters.
        config: Settings.
        learner: Made of the same three; one without memory is built here if left out.
        snapshot: Where to go on from; its state is used up. The beginning if left out.
        watch: Called after every iteration; training ends early if it returns True.
        deterministic: Whether one seed is to give one result on a GPU as well.

    Returns:
        The last snapshot. Its `policy` is the best one, which need not be the last.

    Raises:
        ConfigError: A setting makes no sense.
        TrainingError: The loss is no longer finite.
    """
    if learner is None:
        assert isinstance(config, PPOConfig)
        learner = Learner(env, params, config)
    snapshot = snapshot or begin(learner, params)
    if finished(snapshot, config):
        return snapshot
    params = learner.share(params)
    began = time.perf_counter()
    options = compiling.options() if deterministic else None
    iterate = jax.jit(learner.iterate, donate_argnums=0).lower(snapshot.state, params).compile(options)
    compiled = time.perf_counter()
    while not finished(snapshot, config):
        before = time.perf_counter()
        state, report = iterate(snapshot.state, params)
        snapshot = advance(snapshot, state, report.policy, *fetch(report), config)
        snapshot.record["timing"] = timing(began, compiled, before, config.steps_per_iteration)
        if watch is not None and watch(snapshot):
            break
    return snapshot
