"""Training from settings to the last snapshot: builds the learner, compiles one iteration, and repeats it.

The host only counts finished episodes, keeps the best policy and decides when to stop. An iteration stands in
`learner.py`.
"""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from train import clock
from train.devices import compiler_options
from train.report import fetch, fetch_all
from train.sinks import Log
from train.snapshot import Snapshot, Trainable, advance, finished, started, timing

Watcher = Callable[[Snapshot], bool | None]


def begin(learner: Trainable, params: Any) -> Snapshot:
    """Returns an untrained run."""
    key = learner.share(jax.random.PRNGKey(learner.config.seed))
    state = jax.jit(learner.init, compiler_options=compiler_options(learner.config))(key, learner.share(params))
    return started(learner, state)


def train(
    learner: Trainable,
    params: Any,
    *,
    snapshot: Snapshot | None = None,
    watch: Watcher | None = None,
    log: Log | None = None,
) -> Snapshot:
    """Trains until the goal has held for long enough, or the steps are used up.

    Args:
        learner: From `setup.make_learner`.
        params: Parameters of its environment.
        snapshot: Snapshot to go on from; its state is used up. None is the beginning.
        watch: Called after every iteration; training ends early if it returns True.
        log: Called after every iteration with its line of the log, a dictionary, before `watch`.

    Returns:
        The last snapshot. Its `policy` is the best one, which need not be the last.

    Raises:
        TrainingError: The loss is no longer finite.
    """
    config = learner.config
    snapshot = snapshot or begin(learner, params)
    if finished(snapshot, config):
        return snapshot
    params = learner.share(params)
    began = time.perf_counter()
    clock.lap("start")
    lowered = jax.jit(learner.iterate, donate_argnums=0).lower(snapshot.state, params)
    clock.lap("trace")
    iterate = lowered.compile(compiler_options(config))
    clock.lap("compile")
    compiled = time.perf_counter()
    while not finished(snapshot, config):
        before = time.perf_counter()
        state, report = iterate(snapshot.state, params)
        snapshot = advance(snapshot, state, report.policy, *fetch(report), config)
        snapshot.record["timing"] = timing(began, compiled, before, config.steps_per_iteration)
        if log is not None:
            log(snapshot.record)
        if watch is not None and watch(snapshot):
            break
    clock.lap("train")
    return snapshot


AXIS = "seed"


def seed_axes() -> tuple[str, ...]:
    """Returns the names of the axes along which learners of several seeds are vmapped."""
    return () if jax.default_backend() == "cpu" else (AXIS,)


def over_seeds(function: Callable[..., Any]) -> Callable[..., Any]:
    """Maps a function of a state (or a key) and params over stacked states.

    An accelerator does all seeds together. A CPU, which one seed fills, does one after the other and so keeps the
    branches that `vmap` would take both ways.
    """
    if seed_axes():
        return jax.vmap(function, in_axes=(0, None), axis_name=AXIS)
    return lambda states, params: jax.lax.map(lambda state: function(state, params), states)


def train_seeds(
    learners: list[Trainable],
    params: Any,
    snapshots: list[Snapshot | None],
    watch: Callable[[int, Snapshot], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> list[Snapshot]:
    """Trains until each seed's goal has held for long enough, or its steps are used up.

    A seed comes to the same numbers as if it were trained alone, but for the order of floating-point sums; once it is
    done its numbers stand still while others go on.

    Args:
        learners: One for each seed, alike but for `config.seed`; those of several seeds know `seed_axes()`.
        params: Parameters of the environment.
        snapshots: Snapshots to go on from, all at one iteration but those that are done; None is the beginning.
        watch: Called with the index of the seed after each of its iterations.
        stop: Asked after each iteration whether to end early.

    Returns:
        The last snapshot of each seed.

    Raises:
        TrainingError: The loss of a seed is no longer finite.
    """
    now, first = _begin_missing(learners, params, snapshots), learners[0]
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[snapshot.state for snapshot in now])
    if all(map(_done, now, learners)):
        return now
    began = time.perf_counter()
    clock.lap("start")
    program = jax.jit(over_seeds(first.iterate), donate_argnums=0).lower(states, params)
    clock.lap("trace")
    iterate = program.compile(compiler_options(first.config))
    clock.lap("compile")
    compiled = time.perf_counter()
    while not all(map(_done, now, learners)) and not stop():
        before = time.perf_counter()
        states, reports = iterate(states, params)
        fetched = fetch_all(reports, len(learners))
        timed = timing(began, compiled, before, first.config.steps_per_iteration * len(learners))
        parts = _apart((states, reports.policy), len(learners))
        for k, (learner, (state, policy), (ended, metrics)) in enumerate(zip(learners, parts, fetched, strict=True)):
            if _done(now[k], learner):
                continue
            now[k] = advance(now[k], state, policy, ended, metrics, learner.config)
            now[k].record["timing"] = timed
            if watch is not None:
                watch(k, now[k])
    clock.lap("train")
    return now


def _begin_missing(learners: list[Trainable], params: Any, snapshots: list[Snapshot | None]) -> list[Snapshot]:
    """Returns the snapshots, an untrained one in place of each that is None."""
    known = [snapshot for snapshot in snapshots if snapshot is not None]
    if len(known) == len(snapshots):
        return known
    keys = jnp.stack([jax.random.PRNGKey(learner.config.seed) for learner in learners])
    init = jax.jit(over_seeds(learners[0].init), compiler_options=compiler_options(learners[0].config))
    untrained = _apart(init(keys, params), len(learners))
    return [s or started(learner, state) for s, learner, state in zip(snapshots, learners, untrained, strict=True)]


def _done(snapshot: Snapshot, learner: Trainable) -> bool:
    return finished(snapshot, learner.config)


def _apart(tree: Any, n: int) -> list[Any]:
    """Splits a stacked tree."""
    return [_part(tree, k) for k in range(n)]


@jax.jit
def _part(tree: Any, k: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[k], tree)
