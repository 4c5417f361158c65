"""From a world and settings to a learner: layout, weights to begin with, and refusals before anything is compiled."""

import dataclasses
from typing import Any

import jax
import numpy as np

from subterra_jax.baselines.agent import n_ranges, observed
from subterra_jax.episode import in_tunnel
from subterra_jax.policies.inputs import WAY_AT
from subterra_jax.policies.layout import Layout
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


def make_layout(env: Any, params: Any, config: TrainConfig, localiser: Any = None) -> Layout:
    """Returns the layout of a network for an environment; compiles nothing.

    Args:
        env: A navigation environment.
        params: Its params.
        config: Settings.
        localiser: Weights of the localiser, for `memory = along`.

    Raises:
        ConfigError: A setting does not go with the task.
    """
    kept = Memory(config.memory, config.frames if config.memory == "stack" else 1)
    flat, here = jax.ShapeDtypeStruct((env.observation_size(params),), np.float32), in_tunnel(env, params, 0)

    def look(flat: Any) -> Any:
        return kept.inputs(kept.begin(observed(env, here, flat), here, Given(localiser)))

    bounds = env.action_space(params)
    asks = config.auxiliary and config.memory == "gru"
    if config.auxiliary and env.rule.errand not in ("stop", "return"):
        raise ConfigError(f"auxiliary = True asks for the way to a goal, and {env.id} has none")
    shape = Shape(
        n_inputs=jax.eval_shape(look, flat).shape[0],
        n_action=len(bounds.low),
        hidden=tuple(config.hidden),
        cell=config.cell if config.memory == "gru" else 0,
        way_at=WAY_AT if asks else None,
        init_std=config.init_std,
        half=config.half,
    )
    low, high = (tuple(float(bound) for bound in side) for side in (bounds.low, bounds.high))
    return Layout(kept, shape, low, high, config.standing)


def make_learner(world: World, config: TrainConfig) -> Trainable:
    """Makes the learner of a config on a world.

    Raises:
        ConfigError: A setting makes no sense, or does not go with the task, its sensor or the memory.
    """
    check(config)
    spreads = config.parts > 1
    split: Parts = SPLIT if spreads else ()
    given = Policy(None) if config.begin_from is None else begin_with(config.begin_from)
    env, params = world.env, world.params
    if config.unroll >= int(np.min(np.asarray(params.horizon))):
        raise ConfigError(
            f"unroll = {config.unroll} must be shorter than an episode of {env.id}, {params.horizon} steps"
        )
    if config.memory != "along":
        if config.begin_from is not None and given.network is None:
            raise ConfigError(f"begin_from = {config.begin_from}: a localiser, and memory = {config.memory} takes none")
        driver = Driver(env, make_layout(env, params, config))
        learner = Learner(
            env, driver, config, split, given=_fitting(driver, dataclasses.replace(given, localiser=None))
        )
        return Spread(learner) if spreads else learner
    if env.rule.errand not in ("stop", "return"):
        raise ConfigError(f"memory = along looks along the way to a goal, and {env.id} asks to {env.rule.errand}")
    if n_ranges(params) % 16:
        raise ConfigError(f"memory = along needs 16 level beams or a multiple, and {env.id} has {n_ranges(params)}")
    if given.localiser is None and not config.auxiliary:
        raise ConfigError("memory = along needs auxiliary = True, or a localiser to begin from")
    strip = map_strip(params.tunnel) if config.map else None
    shapes = given.localiser
    if shapes is None or config.map:
        fresh = jax.eval_shape(lambda key: memory.init("transformer", config.front, key, config.map), jax.random.key(0))
        shapes = {**jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), fresh), **(shapes or {})}
    driver = Driver(env, make_layout(env, params, config, shapes), strip)
    localiser = LocaliserLearner(driver, params, config, split, strip) if config.auxiliary else None
    learner = Learner(env, driver, config, split, given=_fitting(driver, given), localiser=localiser)
    return Spread(learner) if spreads else learner


def _fitting(driver: Driver, given: Policy) -> Policy:
    """Returns the weights to begin with; refuses a network of other sizes.

    Raises:
        ConfigError: It is of other sizes.
    """
    if given.network is None:
        return given
    wanted = flat(jax.eval_shape(driver.init, jax.random.key(0)))
    found = flat(given.network)
    for name, leaf in wanted.items():
        tensor = found.get(name)
        # One number more in the inputs, the localiser's doubt, is what `along` adds to a policy without memory.
        if tensor is not None and tensor.shape != leaf.shape and (tensor.shape[0] + 1, *tensor.shape[1:]) == leaf.shape:
            found[name] = np.concatenate([tensor, np.zeros((1, *tensor.shape[1:]), np.float32)])
        elif tensor is None or tensor.shape != leaf.shape:
            has = "no such weights" if tensor is None else f"{tuple(tensor.shape)}"
            raise ConfigError(f"begin_from has another network: {name} is {tuple(leaf.shape)} here and has {has} there")
    return dataclasses.replace(given, network=nested({name: found[name] for name in wanted}))
