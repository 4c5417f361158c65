"""The network that a recurrent run asks for."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

import subterra_jax as st
from subterra_jax.policies import senses
from train.errors import ConfigError
from train.recurrent import drive as driving
from train.recurrent.config import RecurrentConfig
from train.recurrent.network import RecurrentLayout

_SLACK = 0.25


def require_goal(env: Any) -> None:
    """Refuses what such a network cannot do.

    Raises:
        ConfigError: The task has no goal.
    """
    if env.rule.errand not in ("stop", "return"):
        raise ConfigError(f"memory = gru learns to drive to a goal and stop, which {env.id} does not ask for")


def make_layout(env: Any, params: Any, config: RecurrentConfig) -> RecurrentLayout:
    """The network that `config` asks for on this environment; nothing is compiled for it."""
    bounds, shown = env.action_space(params), senses_of(params, config)
    observation = jax.ShapeDtypeStruct((1, env.observation_size(params)), jnp.float32)
    batch = st.batch.AutoReset(env)
    shapes = jax.eval_shape(lambda obs: _shapes(env, batch, params, obs, shown), observation)
    return RecurrentLayout(
        n_features=shapes[0].shape[-1],
        n_truth=shapes[1].shape[-1],
        # To stand must not lie at the end of a tanh; the environment reads a speed below 0 as 0.
        action_low=(float(bounds.low[0]) - _SLACK * float(bounds.high[0]), float(bounds.low[1])),
        action_high=tuple(float(bound) for bound in bounds.high[:2]),
        hidden=config.hidden,
        bins=config.bins,
        bin_width=config.bin_width,
        init_std=config.init_std,
        min_std=config.min_std,
        tracker=shown.tracker,
        boxes=shown.boxes,
    )


def senses_of(params: Any, config: RecurrentConfig) -> senses.Senses:
    """What the network is shown: what the config says, and else what the task is about."""
    among_boxes = "obstacles" in params.parts
    return senses.Senses(config.tracker or ("careful" if among_boxes else senses.PLAIN.tracker), among_boxes)


def _shapes(env: Any, batch: Any, params: Any, observation: Array, shown: senses.Senses) -> tuple[Array, Array]:
    _, state = batch.reset(jax.random.key(0), params, 1)
    view = driving.look(env, params, observation, senses.start((1,), params.lidar.n_beams, shown))
    return view.features, driving.truth(env, params, state, view, jnp.zeros(1))
