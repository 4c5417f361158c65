"""Several seeds of one run at once: one compiled iteration for all of them, a folder and a curve for each."""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from subterra_jax.host.command import EXIT_INTERRUPTED
from train import cli, curve
from train.devices import compiling
from train.errors import ConfigError
from train.run import milestones
from train.run.checkpoint import iterations
from train.run.fetching import fetch_all
from train.run.log import Bar
from train.run.session import Session
from train.run.snapshot import Snapshot, Trainable, advance, finished, started, timing

AXIS = "seed"
Watcher = Callable[[int, Snapshot], None]


def check(seeds: tuple[int, ...]) -> None:
    """Raises `ConfigError` for a seed below 0 or one that is named twice."""
    for seed in seeds:
        if seed < 0:
            raise ConfigError(f"seeds must not be negative, got {seed}")
        if seeds.count(seed) > 1:
            raise ConfigError(f"seed {seed} is named {seeds.count(seed)} times")


def axes() -> tuple[str, ...]:
    """Names of the axes along which learners of several seeds are vmapped, as they have to be told."""
    return () if jax.default_backend() == "cpu" else (AXIS,)


def over_seeds(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of a state, or a key, and params, over stacked ones of the former.

    An accelerator does all seeds together. A CPU, which one seed fills, does one after the other and so keeps the
    branches that `vmap` would take both ways.
    """
    if axes():
        return jax.vmap(function, in_axes=(0, None), axis_name=AXIS)
    return lambda states, params: jax.lax.map(lambda state: function(state, params), states)


def train(
    learners: list[Trainable],
    params: Any,
    snapshots: list[Snapshot | None],
    watch: Watcher | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> list[Snapshot]:
    """Trains until each seed's goal has held for long enough, or its steps are used up.

    A seed comes to the same numbers as if it were trained alone, but for the order of floating-point sums; once it is
    done its numbers stand still while others go on.

    Args:
        learners: One for each seed, alike but for `config.seed`; those of several seeds know `axes()`.
        params: Parameters of the environment.
        snapshots: Where to go on from, all at the same iteration but those that are done; None is the beginning.
        watch: Called with the index of the seed after each of its iterations.
        stop: Asked after each iteration whether to end early.

    Returns:
        The last snapshot of each seed.

    Raises:
        TrainingError: The loss of a seed is no longer finite.
    """
    first, options = learners[0], compiling.options()
    if any(snapshot is None for snapshot in snapshots):
        keys = jnp.stack([jax.random.PRNGKey(learner.config.seed) for learner in learners])
        states = jax.jit(over_seeds(first.init), compiler_options=options)(keys, params)
        now = [started(learner, state) for learner, state in zip(learners, _apart(states, len(learners)), strict=True)]
    else:
        now = [snapshot for snapshot in snapshots if snapshot is not None]
        states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[snapshot.state for snapshot in now])
    if all(map(_done, now, learners)):
        return now
    began = time.perf_counter()
    iterate = jax.jit(over_seeds(first.iterate), donate_argnums=0).lower(states, params).compile(options)
    compiled = time.perf_counter()
    while not all(map(_done, now, learners)) and not stop():
        before = time.perf_counter()
        states, reports = iterate(states, params)
        told = fetch_all(reports, len(learners))
        timed = timing(began, compiled, before, first.config.steps_per_iteration * len(learners))
        parts = _apart((states, reports.policy), len(learners))
        for k, (learner, (state, policy), (ended, metrics)) in enumerate(zip(learners, parts, told, strict=True)):
            if not _done(now[k], learner):
                now[k] = advance(now[k], state, policy, ended, metrics, learner.config)
                now[k].record["timing"] = timed
                if watch is not None:
                    watch(k, now[k])
    return now


def run(out: Path, sessions: list[Session], *, resume: bool, overwrite: bool, episodes: int) -> int:
    """Trains, draws and evaluates every seed; prints what each took to reach the goal.

    Returns:
        Exit status: 0, or 130 after Ctrl-C, with the checkpoints saved.
    """
    snapshots = resumed(sessions) if resume else [s.folder.begin(resume=False, overwrite=overwrite) for s in sessions]
    config = sessions[0].learner.config
    for session, snapshot in zip(sessions, snapshots, strict=True):
        session.open(snapshot)
    bar = Bar(config.steps, max((s.iteration for s in snapshots if s), default=0) * config.steps_per_iteration)
    with cli.deferred_interrupt() as interrupt:

        def watch(k: int, now: Snapshot) -> None:
            bar.show(now.record, of=f"seed {sessions[k].learner.config.seed}")
            sessions[k].note(now, save=interrupt.wanted)

        try:
            last = train(
                [session.learner for session in sessions],
                sessions[0].world.params,
                snapshots,
                watch,
                lambda: interrupt.wanted,
            )
        finally:
            bar.close()
            for session in sessions:
                session.close()
        for session, snapshot in zip(sessions, last, strict=True):
            session.finish(snapshot)
        curve.write_curve([session.folder.path for session in sessions], out / "curve.png")
        if interrupt.wanted:
            print("interrupted; go on with --resume", file=sys.stderr)
            return EXIT_INTERRUPTED
    found = [session.score(snapshot, episodes) for session, snapshot in zip(sessions, last, strict=True)]
    milestones.tell(out, [session.folder.path for session in sessions], found)
    return 0


def resumed(sessions: list[Session]) -> list[Snapshot | None]:
    """Where every seed stood, those that are not done at their last common iteration.

    Raises:
        ConfigError: They have none.
    """
    found: list[Snapshot | None] = [session.folder.begin(resume=True, overwrite=False) for session in sessions]
    behind = [k for k, s in enumerate(found) if s is not None and not _done(s, sessions[k].learner)]
    common = set.intersection(*[set(iterations(sessions[k].folder.path)) for k in behind]) if behind else set()
    if behind and not common:
        raise ConfigError(f"{sessions[0].folder.path.parent}: the seeds have no iteration in common; resume each alone")
    for k in behind:
        found[k] = sessions[k].folder.resume(max(common))
    return found


def _done(snapshot: Snapshot, learner: Trainable) -> bool:
    return finished(snapshot, learner.config)


def _apart(tree: Any, n: int) -> list[Any]:
    """The parts of a stacked tree."""
    return [_part(tree, k) for k in range(n)]


@jax.jit
def _part(tree: Any, k: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[k], tree)
