"""From a world and settings to a learner: layout, weights to begin with, and refusals before anything is compiled."""

from typing import Any

import jax
import numpy as np

from subterra_jax.baselines.agent import observed
from subterra_jax.policies.inputs import WAY_AT
from subterra_jax.policies.layout import Layout
from subterra_jax.policies.memories import Given, Memory
from subterra_jax.policies.network import Shape
from train.config import ConfigError, TrainConfig, check
from train.devices import PART, SPLIT, Parts, Spread
from train.driver import Driver, Policy
from train.learner import Learner
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
    memory = Memory(config.memory, config.frames if config.memory == "stack" else 1)
    flat = jax.ShapeDtypeStruct((env.observation_size(params),), np.float32)

    def look(flat: Any) -> Any:
        return memory.inputs(memory.begin(observed(env, params, flat), params, Given(localiser)))

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
    return Layout(memory, shape, low, high)


def make_learner(world: World, config: TrainConfig, axes: Parts = ()) -> Trainable:
    """Makes the learner of a config on a world.

    Raises:
        ConfigError: A setting makes no sense, or does not go with the task, its sensor or the memory.
    """
    check(config)
    spreads = config.parts > 1
    names: tuple[Parts, Parts] = ((PART,), SPLIT) if spreads else (axes, ())
    driver = Driver(world.env, make_layout(world.env, world.params, config))
    learner = Learner(world.env, driver, config, *names, given=Policy(None))
    return Spread(learner) if spreads else learner
