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
from train.devices import compiler_options
from train.report import fetch
from train.sinks import Log
from train.snapshot import Snapshot, Trainable, advance, finished, started, timing

Watcher = Callable[[Snapshot], bool | None]


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
        RewardError: The reward is not finite.
        TrainingError: The loss is no longer finite.
    """
    ended = False

    def tell(seed: int, now: Snapshot) -> None:
        nonlocal ended
        if log is not None:
            log(now.record)
        ended = watch is not None and bool(watch(now))

    return train_seeds([learner], params, [snapshot], tell, lambda: ended)[0]


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
        RewardError: The reward of a seed is not finite.
        TrainingError: The loss of a seed is no longer finite.
    """
    known = [snapshot for snapshot in snapshots if snapshot is not None]
    if len(known) == len(learners) and all(map(_done, known, learners)):
        return known
    began, first, n = time.perf_counter(), learners[0], len(learners)
    params = first.share(params)
    keys = _joined([learner.share(jax.random.PRNGKey(learner.config.seed)) for learner in learners])
    states = _joined([snapshot.state for snapshot in known]) if len(known) == n else None
    states, iterate = _compile(over_seeds(first.init, n), over_seeds(first.iterate, n), keys, params, states, first)
    now = [s or started(learner, x) for s, learner, x in zip(snapshots, learners, _apart(states, n), strict=True)]
    if 0 < len(known) < n:
        states = _joined([snapshot.state for snapshot in now])
    compiled = time.perf_counter()
    while not all(map(_done, now, learners)) and not stop():
        before = time.perf_counter()
        states, reports = iterate(states, params)
        fetched = fetch(reports, None if n == 1 else n)
        timed = timing(began, compiled, before, first.config.steps_per_iteration * n)
        parts = _apart((states, reports.policy), n)
        for k, (learner, (state, policy), (ended, metrics)) in enumerate(zip(learners, parts, fetched, strict=True)):
            if _done(now[k], learner):
                continue
            now[k] = advance(now[k], state, policy, ended, metrics, learner.config)
            now[k].record["timing"] = timed
            if watch is not None:
                watch(k, now[k])
    clock.lap("train")
    return now


def over_seeds(function: Callable[..., Any], n: int) -> Callable[..., Any]:
    """Maps a function of a state (or a key) and params over `n` stacked states; one alone is not stacked.

    An accelerator does all seeds together; a CPU, which one seed fills, does one after the other.
    """
    if n == 1:
        return function
    if jax.default_backend() != "cpu":
        return jax.vmap(function, in_axes=(0, None))
    return lambda states, params: jax.lax.map(lambda state: function(state, params), states)


def _compile(init: Any, iterate: Any, key: Any, params: Any, state: Any, learner: Trainable) -> tuple[Any, Any]:
    """Compiles the beginning of a run and its iteration at the same time.

    Args:
        init: From key and params to a state.
        iterate: From state and params to the next state and a report.
        key: Of the seed, or of all seeds.
        params: Parameters of the environment.
        state: State to go on from; None begins anew.
        learner: Has the settings.

    Returns:
        The state, and the compiled iteration.
    """
    options = compiler_options(learner.config)
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


def _done(snapshot: Snapshot, learner: Trainable) -> bool:
    return finished(snapshot, learner.config)


def _joined(trees: list[Any]) -> Any:
    """Stacks trees; one alone stays as it is."""
    return trees[0] if len(trees) == 1 else jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def _apart(tree: Any, n: int) -> list[Any]:
    """Splits what `_joined` joined."""
    return [tree] if n == 1 else [_part(tree, k) for k in range(n)]


@jax.jit
def _part(tree: Any, k: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[k], tree)
