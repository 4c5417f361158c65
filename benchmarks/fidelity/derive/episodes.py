"""Episodes of the environment on the planar tunnel: whether they repeat, and how far the odometer drifts."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

import subterra_jax as st
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.planarenv import environment
from benchmarks.fidelity.derive.released import of_released
from subterra_jax import odometry
from subterra_jax.state import EnvParams, State

_STEPS = 64
_ODOMETRY = 100.0  # m
_EPISODES = 256


@of_released("tunnel")
def repeats(case: Case) -> Bool[np.ndarray, " k"]:
    """Whether each observation of an episode comes out the same in an environment made a second time."""
    actions = case.rng("env_determinism").uniform(-1.0, 2.0, (_STEPS, 2)).astype(np.float32)
    one, other = (_episode(case, actions) for _ in range(2))
    return np.array([np.array_equal(a, b) for a, b in zip(one, other, strict=True)])


def _episode(case: Case, actions: np.ndarray) -> np.ndarray:
    env, params = environment(case)
    return np.asarray(_roll(env, params, jax.random.key(case.seed), actions))


@partial(jax.jit, static_argnums=0)
def _roll(env: st.TunnelEnv, params: EnvParams, key: jax.Array, actions: jax.Array) -> jax.Array:
    """Observations of an episode, the first one included."""
    begin, go = jax.random.split(key)
    first, state = env.reset(begin, params)

    def one(state: State, inputs: tuple[jax.Array, jax.Array]) -> tuple[State, jax.Array]:
        observation, state, *_ = env.step(inputs[0], state, inputs[1], params)
        return state, observation

    rest = jax.lax.scan(one, state, (jax.random.split(go, len(actions)), actions))[1]
    return jnp.concatenate([first[None], rest])


@of_released("tunnel")
def odometry_drift(case: Case) -> float:
    """Root mean square error of the environment's odometer after 100 m at its top speed, m."""
    env, params = environment(case)
    speed, period = float(params.vehicle.speed_max), float(params.vehicle.period)
    interval = jnp.asarray(params.vehicle.period)
    steps = int(_ODOMETRY / (speed * period))

    def episode(key: jax.Array) -> jax.Array:
        begin, go = jax.random.split(key)
        start = env.begin(env.draw_reset(begin, (), params), params).odometry
        drawn = env.draw_step(go, (steps,), params).odometry
        motion = jnp.array([speed, 0.0])
        advance = odometry.advance_odometry
        last = jax.lax.scan(lambda s, n: (advance(s, motion, interval, n, params.odometry), None), start, drawn)[0]
        return last.distance - steps * speed * period

    error = jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(case.seed), _EPISODES))
    return float(np.sqrt(np.mean(np.asarray(error) ** 2)) * 100.0 / (steps * speed * period))
