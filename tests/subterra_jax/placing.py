"""A robot at a chosen place, and its observation by the names of its entries."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np


def placed(env, params, x, y=0.0, heading=0.0):
    _, state = env.reset(jax.random.key(0), params)
    number = jnp.float32
    return dataclasses.replace(
        state, position=jnp.array([x, y], number), heading=number(heading), station=number(x), lateral=number(y)
    )


def observe(env, state, params, key=1):
    flat = jax.jit(env.observe)(state, env.draw_step(jax.random.key(key), (), params), params)
    return {name: np.asarray(flat[at]) for name, at in env.fields(params).items()}
