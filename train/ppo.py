"""Training from settings to the last snapshot: builds the learner, compiles one iteration, and repeats it.

The host only counts finished episodes, keeps the best policy and decides when to stop. An iteration stands in the
`learner.py` of `feedforward`, `recurrent` and `belief`, and in `recurrent/distill.py`.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from subterra_jax.baselines import registry
from subterra_jax.baselines.agent import Agent
from subterra_jax.policies import PolicyError, check_fits
from train.belief.learner import BeliefConfig, BeliefLearner, check_belief
from train.checkpoint import CheckpointError
from train.config import ConfigError, PPOConfig, TrainConfig, check
from train.devices import PART, SPLIT, Parts, Spread, compiler_options
from train.feedforward.learner import Learner
from train.policies import open_agent, policy_weights
from train.recurrent.config import (
    DistillConfig,
    RecurrentConfig,
    check_distill,
    check_recurrent,
)
from train.recurrent.distill import DistillLearner
from train.recurrent.drive import make_layout
from train.recurrent.learner import RecurrentLearner
from train.recurrent.network import RecurrentNetworks
from train.report import fetch, fetch_all
from train.sinks import Log
from train.snapshot import Snapshot, Trainable, advance, finished, started, timing
from train.world import World


def check_config(config: TrainConfig) -> None:
    """Refuses settings that make no sense, before the tunnel is opened.

    Raises:
        ConfigError: Naming the first setting that does not, and its value.
    """
    _method(config).check(config)


def make_learner(world: World, config: TrainConfig, axes: tuple[str, ...] = ()) -> Trainable:
    """Makes the learner of a config on a world.

    Raises:
        ConfigError: A setting makes no sense, no such network can learn this task, or no such teacher knows it.
    """
    spreads = config.parts > 1
    names: tuple[Parts, Parts] = ((PART,), SPLIT) if spreads else (axes, ())
    learner = _method(config).learner(world, config, *names)
    return Spread(learner) if spreads else learner


class Method(NamedTuple):
    """A way to train.

    Attributes:
        check: Refuses settings that make no sense.
        learner: Makes the learner of world, config, and the names of its axes and of those along which it is split.
    """

    check: Callable[[Any], Any]
    learner: Callable[[World, Any, Parts, Parts], Any]


def _by_reward(world: World, config: PPOConfig, axes: Parts, split: Parts) -> Learner:
    return Learner(world.env, world.params, config, axes, split)


def _with_memory(world: World, config: RecurrentConfig, axes: Parts, split: Parts) -> RecurrentLearner:
    return RecurrentLearner(world.env, world.params, config, axes, split, _begun(world, config))


def _from_teacher(world: World, config: DistillConfig, axes: Parts, split: Parts) -> DistillLearner:
    teacher = open_teacher(config.teacher, world)
    return DistillLearner(world.env, world.params, config, teacher, axes, split, _begun(world, config))


def _sensor_on_map(world: World, config: BeliefConfig, axes: Parts, split: Parts) -> BeliefLearner:
    return BeliefLearner(world.env, world.params, config, axes, split)


METHODS: dict[type[TrainConfig], Method] = {
    PPOConfig: Method(check, _by_reward),
    RecurrentConfig: Method(check_recurrent, _with_memory),
    DistillConfig: Method(check_distill, _from_teacher),
    BeliefConfig: Method(check_belief, _sensor_on_map),
}


def _method(config: TrainConfig) -> Method:
    """Finds the method of a config: that of its class, or of the nearest class that it inherits from."""
    return next(METHODS[one] for one in type(config).__mro__ if one in METHODS)


def _begun(world: World, config: RecurrentConfig) -> dict[str, Any] | None:
    """Returns the weights of the policy to begin with."""
    if config.begin_from is None:
        return None
    try:
        agent, _ = open_agent(Path(config.begin_from), None)
    except (PolicyError, CheckpointError) as error:
        raise ConfigError(f"begin_from = {config.begin_from}: {error}") from error
    networks = RecurrentNetworks(make_layout(world.env, world.params, config))
    return policy_weights(networks, agent.tensors, config.begin_from)


def open_teacher(name: str, world: World) -> Agent:
    """Opens a baseline by its name, or a policy: released, or of a run folder.

    Raises:
        ConfigError: There is neither, or it cannot do this task.
    """
    if name in registry.names():
        return registry.make_agent(name, world.params)
    try:
        agent, _ = open_agent(Path(name), None)
        check_fits(agent, world.env, world.params, name)
    except (PolicyError, CheckpointError) as error:
        raise ConfigError(f"teacher = {name} is no baseline ({', '.join(registry.names())}): {error}") from error
    return agent


Watcher = Callable[[Snapshot], bool | None]


def begin(learner: Trainable, params: Any) -> Snapshot:
    """Returns an untrained run."""
    key = learner.share(jax.random.PRNGKey(learner.config.seed))
    state = jax.jit(learner.init, compiler_options=compiler_options(learner.config))(key, learner.share(params))
    return started(learner, state)


def train(
    env: Any,
    params: Any,
    config: TrainConfig,
    *,
    learner: Trainable | None = None,
    snapshot: Snapshot | None = None,
    watch: Watcher | None = None,
    log: Log | None = None,
) -> Snapshot:
    """Trains until the goal has held for long enough, or the steps are used up.

    Args:
        env: A navigation environment, as `st.make` returns it.
        params: Its parameters.
        config: Settings.
        learner: Made of the same three; one without memory is built here if left out.
        snapshot: Snapshot to go on from; its state is used up. None is the beginning.
        watch: Called after every iteration; training ends early if it returns True.
        log: Called after every iteration with its line of the log, a dictionary, before `watch`.

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
    options = compiler_options(config)
    iterate = jax.jit(learner.iterate, donate_argnums=0).lower(snapshot.state, params).compile(options)
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
    program = jax.jit(over_seeds(first.iterate), donate_argnums=0).lower(states, params)
    iterate = program.compile(compiler_options(first.config))
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
