"""Training from settings to the last snapshot: builds the learner, compiles one iteration, and repeats it.

The host only counts finished episodes, keeps the best policy and decides when to stop. An iteration stands in
`learner.py`.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp

from train import clock
from train.config import TrainConfig
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


def _compile(init: Any, iterate: Any, key: Any, params: Any, state: Any, config: TrainConfig) -> tuple[Any, Any]:
    """Compiles the beginning of a run and its iteration at the same time.

    Args:
        init: From key and params to a state.
        iterate: From state and params to the next state and a report.
        key: Of the seed, or of all seeds.
        params: Parameters of the environment.
        state: State to go on from; None begins anew.
        config: Settings.

    Returns:
        The state, and the compiled iteration.
    """
    options = compiler_options(config)
    clock.lap("start")
    first = None if state is not None else jax.jit(init).lower(key, params)
    like = jax.eval_shape(init, key, params) if state is None else state
    lowered = jax.jit(iterate, donate_argnums=0).lower(like, params)
    clock.lap("trace")
    with ThreadPoolExecutor(1) as pool:
        compiled = pool.submit(lowered.compile, options)
        if first is not None:
            state = first.compile(options)(key, params)
        program = compiled.result()
    clock.lap("compile")
    return state, program


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
    if snapshot is not None and finished(snapshot, config):
        return snapshot
    params, began = learner.share(params), time.perf_counter()
    key = learner.share(jax.random.PRNGKey(config.seed))
    so_far = None if snapshot is None else snapshot.state
    state, iterate = _compile(learner.init, learner.iterate, key, params, so_far, config)
    snapshot = snapshot or started(learner, state)
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


def over_seeds(function: Callable[..., Any]) -> Callable[..., Any]:
    """Maps a function of a state (or a key) and params over stacked states.

    An accelerator does all seeds together; a CPU, which one seed fills, does one after the other.
    """
    if jax.default_backend() != "cpu":
        return jax.vmap(function, in_axes=(0, None))
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
        learners: One for each seed, alike but for `config.seed`.
        params: Parameters of the environment.
        snapshots: Snapshots to go on from, all at one iteration but those that are done; None is the beginning.
        watch: Called with the index of the seed after each of its iterations.
        stop: Asked after each iteration whether to end early.

    Returns:
        The last snapshot of each seed.

    Raises:
        TrainingError: The loss of a seed is no longer finite.
    """
    began, first = time.perf_counter(), learners[0]
    done = [s is not None and finished(s, learner.config) for s, learner in zip(snapshots, learners, strict=True)]
    if all(done):
        return [snapshot for snapshot in snapshots if snapshot is not None]
    known = None if None in snapshots else [snapshot.state for snapshot in snapshots if snapshot is not None]
    states = None if known is None else jax.tree.map(lambda *leaves: jnp.stack(leaves), *known)
    keys = jnp.stack([jax.random.PRNGKey(learner.config.seed) for learner in learners])
    states, iterate = _compile(over_seeds(first.init), over_seeds(first.iterate), keys, params, states, first.config)
    fresh = _apart(states, len(learners))
    now = [s or started(learner, state) for s, learner, state in zip(snapshots, learners, fresh, strict=True)]
    if known is None and any(snapshot is not None for snapshot in snapshots):
        states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[snapshot.state for snapshot in now])
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


def _done(snapshot: Snapshot, learner: Trainable) -> bool:
    return finished(snapshot, learner.config)


def _apart(tree: Any, n: int) -> list[Any]:
    """Splits a stacked tree."""
    return [_part(tree, k) for k in range(n)]


@jax.jit
def _part(tree: Any, k: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[k], tree)
