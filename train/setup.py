"""From a world and settings to a learner: layout, weights to begin with, and refusals before anything is compiled."""

import dataclasses
from typing import Any

import jax
import numpy as np

from subterra_jax.baselines.agent import n_ranges, observed
from subterra_jax.baselines.histogram import HistogramLocaliser
from subterra_jax.episode import in_tunnel
from subterra_jax.policies.inputs import N_WALLS, WAY_AT
from subterra_jax.policies.learnt import Layout
from subterra_jax.policies.locate import memory
from subterra_jax.policies.locate.map_strip import map_strip
from subterra_jax.policies.memories import Given, Memory
from subterra_jax.policies.network import Shape
from subterra_jax.policies.trained import flat, nested
from train.config import ConfigError, TrainConfig, check
from train.devices import SPLIT, Parts, Spread
from train.driver import Driver, Policy
from train.learner import Learner
from train.localiser import LocaliserLearner
from train.policies import begin_with
from train.snapshot import Trainable
from train.world import World

# Tasks in which a localiser is of use.
_GOAL_KINDS = {"along": ("stop", "return"), "map": ("stop", "return", "report")}


def make_layout(env: Any, params: Any, config: TrainConfig, given: Given | None = None) -> Layout:
    """Returns the layout of a network for an environment; compiles nothing.

    Args:
        env: A navigation environment.
        params: Its params.
        config: Settings.
        given: Weights of the localiser for `memory = along`, the filter for `map`.

    Raises:
        ConfigError: A setting does not go with the task.
    """
    kept = Memory(config.memory, config.frames, config.map_cell, config.walls)
    flat, here = jax.ShapeDtypeStruct((env.observation_size(params),), np.float32), in_tunnel(env, params, 0)

    def look(flat: Any) -> Any:
        return kept.inputs(kept.begin(observed(env, here, flat), here, given or Given()))

    bounds = env.action_space(params)
    # What the filter believes is the report, and the network is left with the command.
    n_action = 2 if config.memory == "map" else len(bounds.low)
    asks = config.auxiliary and config.memory == "gru"
    if config.auxiliary and env.rule.goal_kind not in ("stop", "return"):
        raise ConfigError(f"auxiliary = True asks for the way to a goal, and {env.id} has none")
    shape = Shape(
        n_inputs=jax.eval_shape(look, flat).shape[0],
        n_action=n_action,
        hidden=tuple(config.hidden),
        cell=config.cell if config.memory == "gru" else 0,
        way_at=WAY_AT if asks else None,
        init_std=config.init_std,
        init_turn=config.init_turn,
    )
    low, high = (tuple(float(bound) for bound in side[:n_action]) for side in (bounds.low, bounds.high))
    if config.cruise is not None:
        high = (min(config.cruise, high[0]), *high[1:])
    return Layout(kept, shape, low, high, config.standing)


def make_learner(world: World, config: TrainConfig) -> Trainable:
    """Makes the learner of a config on a world.

    Raises:
        ConfigError: A setting makes no sense, or does not go with the task, its sensor or the memory.
    """
    check(config)
    given = Policy(None) if config.begin_from is None else begin_with(config.begin_from)
    env, params = world.env, world.params
    _check_world(env, params, config, given)
    split: Parts = SPLIT if config.parts > 1 else ()
    map: Any = None
    localiser, shapes = None, None
    if config.memory == "along":
        shapes, map = _shapes(given.localiser, config), map_strip(params.tunnel) if config.map else None
    else:
        given = dataclasses.replace(given, localiser=None)
    if config.memory == "map":
        map = HistogramLocaliser.of(params, cell=config.map_cell)
    driver = Driver(env, make_layout(env, params, config, Given(shapes, map)), map)
    if config.memory == "along" and config.auxiliary:
        localiser = LocaliserLearner(driver, params, config, split, map)
    learner = Learner(env, driver, config, split, given=_fitting(driver, given, config), localiser=localiser)
    return Spread(learner) if split else learner


def _check_world(env: Any, params: Any, config: TrainConfig, given: Policy) -> None:
    """Raises `ConfigError` where a setting does not go with the task, its sensor or the weights to begin with."""
    if config.unroll >= int(np.min(np.asarray(params.horizon))):
        raise ConfigError(
            f"unroll = {config.unroll} must be shorter than an episode of {env.id}, {params.horizon} steps"
        )
    goal_kinds = _GOAL_KINDS.get(config.memory)
    if goal_kinds is not None and env.rule.goal_kind not in goal_kinds:
        raise ConfigError(
            f"memory = {config.memory} is for tasks that ask to {' or '.join(goal_kinds)}, and {env.id} asks to "
            f"{env.rule.goal_kind}"
        )
    if config.memory != "along":
        if config.begin_from is not None and given.network is None:
            raise ConfigError(f"begin_from = {config.begin_from}: a localiser, and memory = {config.memory} takes none")
        return
    if n_ranges(params) % 16:
        raise ConfigError(f"memory = along needs 16 level beams or a multiple, and {env.id} has {n_ranges(params)}")
    if given.localiser is None and not config.auxiliary:
        raise ConfigError("memory = along needs auxiliary = True, or a localiser to begin from")


def _shapes(given: Any, config: TrainConfig) -> Any:
    """Returns weights of the localiser by whose shapes a policy is laid out: those given, and zeros for the others."""
    if given is not None and not config.map:
        return given
    fresh = jax.eval_shape(lambda key: memory.init(config.front, key, config.map), jax.random.key(0))
    return {**jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), fresh), **(given or {})}


def _fitting(driver: Driver, given: Policy, config: TrainConfig) -> Policy:
    """Returns the weights to begin with; refuses a network of other sizes.

    Raises:
        ConfigError: It is of other sizes.
    """
    if given.network is None:
        return given
    needed, source = flat(jax.eval_shape(driver.init, jax.random.key(0))), config.begin_from
    found = flat(given.network)
    for name, leaf in needed.items():
        tensor = found.get(name)
        wider = None if tensor is None else _widened(tensor, leaf.shape, config.frames)
        if wider is None:
            has = "no such weights" if tensor is None else f"{tuple(tensor.shape)}"
            raise ConfigError(
                f"begin_from = {source} has another network: {name} is {tuple(leaf.shape)} here and has {has} there"
            )
        found[name] = wider
    return dataclasses.replace(given, network=nested({name: found[name] for name in needed}))


def _widened(tensor: np.ndarray, shape: tuple[int, ...], frames: int) -> np.ndarray | None:
    """Returns weights for more inputs, 0 for those that are new; None where they do not fit.

    The localiser's doubt is what `along` adds to each observation of a policy that has none, and the walls beside the
    robot, where they are shown; earlier observations come before the newest.
    """
    if tensor.shape == shape:
        return tensor
    if tensor.shape[1:] != shape[1:]:
        return None
    for known in (frames, 1):
        more = shape[0] // frames - tensor.shape[0] // known
        if tensor.shape[0] % known == 0 and more in (0, 1, N_WALLS, 1 + N_WALLS):
            rows = tensor.reshape(known, -1, *tensor.shape[1:])
            return np.pad(rows, [(frames - known, 0), (0, more), *[(0, 0)] * (tensor.ndim - 1)]).reshape(shape)
    return None
