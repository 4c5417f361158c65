"""Drives to learn a localiser from: the policy steers, at speeds that vary, from anywhere, beside the truth."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.baselines.agent import observed
from subterra_jax.baselines.steering import CentreLine
from subterra_jax.policies import inputs
from subterra_jax.policies.locate import bends
from subterra_jax.policies.locate.streams import Record
from subterra_jax.rules.rule import Choice
from train.driver import Driver, Policy

_FULL = 0.6  # fraction of drives at full speed
_AS_THE_TASK = 0.4  # fraction of drives that start where the task does
_SLOWEST = 0.5  # of full speed
_LEAST = 0.2  # of full speed: a drive goes on
_END = 5.0  # m before the end of the tunnel at which a drive ends


@struct.dataclass
class Drives:
    """Drives of a batch."""

    record: Record  # as the robots saw them
    moved: Float[Array, "env time"]  # true distance along the axis since the start, m
    start: Float[Array, "env"]  # true station of the start, m
    tunnel: Float[Array, "env"]  # number of the tunnel


def record_drives(driver: Driver, policy: Policy, params: Any, key: PRNGKeyArray, n_envs: int, n_steps: int) -> Drives:
    """Drives `n_envs` robots for `n_steps` steps; a robot that meets the end, or a wall, stands there.

    Args:
        driver: What drives, in its environment, which must start facing growing stations.
        policy: Its weights; it steers as to a goal far away.
        params: Parameters of the environment.
        key: Source of everything random.
        n_envs: Number of robots.
        n_steps: Number of steps.
    """
    env, vehicle, walls_of = driver.env, params.vehicle, CentreLine()
    keys = jax.random.split(key, 5)
    state = _starts(env, params, keys, n_envs, vehicle.speed_max * vehicle.period * n_steps * 1.1 + 20.0)
    pace = jax.vmap(_pace)(jax.random.split(keys[2], n_envs))

    def see(state: Any, noise: Any) -> Any:
        return observed(env, params, env.observe(state, noise, params))

    def begin(obs: Any) -> Any:
        return inputs.begin(obs), walls_of.begin(obs, params)

    def look(kept: Any, obs: Any, command: Array) -> Any:
        reckoned, walls = kept
        reckoned = inputs.see(inputs.obey(reckoned, command, vehicle.period), obs)
        return reckoned, walls_of.look(walls, obs, command, params)

    def read(kept: Any, obs: Any) -> Array:
        return driver.layout.memory.far_from_goal(kept[0], kept[1], obs, params)

    seen = jax.vmap(see)(state, env.draw_step(keys[3], (n_envs,), params))
    zero = jnp.zeros(n_envs)

    def step(carry: Any, t: Array) -> Any:
        state, seen, kept, command, driven, over, bend = carry
        kept = jax.vmap(look)(kept, seen, command)
        moved = command[:, 0] * vehicle.period * jax.vmap(walls_of.cosine)(kept[1])
        driven = driven + moved
        points, bend = jax.vmap(lambda b, obs, w, m: bends.look(b, obs, w, m, params))(bend, seen, kept[1], moved)
        row = Record(driven, seen.distance, points), state.station
        out, _ = driver.answer(policy, jax.vmap(read)(kept, seen), driver.start_memory((n_envs,)))
        command = driver.action(driver.sample(out, jax.random.fold_in(keys[4], t)))[:, :2]
        fraction = jax.vmap(lambda p: _speed(p, t))(pace)
        speed = jnp.maximum(command[:, 0], _LEAST * vehicle.speed_max) * fraction
        command = jnp.where(over[:, None], 0.0, jnp.stack([speed, command[:, 1]], axis=1))
        noise = env.draw_step(jax.random.fold_in(keys[3], t + 1), (n_envs,), params)
        action = jnp.pad(command, ((0, 0), (0, env.action_size - 2)))
        state, _, _, _, info = jax.vmap(lambda s, a, z: env.advance(s, a, z, params))(state, action, noise)
        end = jax.vmap(lambda s: params.tunnel.pick(s.tunnel).length)(state) - _END
        over = over | info["contact"] | (state.station > end)
        return (state, jax.vmap(see)(state, noise), kept, command, driven, over, bend), row

    start = state.station
    carry: Any = (state, seen, jax.vmap(begin)(seen), jnp.zeros((n_envs, 2)), zero, zero > 0.0, zero)
    (state, *_), (record, station) = jax.lax.scan(step, carry, jnp.arange(n_steps))
    record = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), record)
    return Drives(record, jnp.swapaxes(station, 0, 1) - start[:, None], start, state.tunnel)


def _starts(env: Any, params: Any, keys: Array, n: int, room: Any) -> Any:
    """Returns states to drive from: some where the task starts, the others anywhere with `room` m before them."""
    draws = env.draw_reset(keys[0], (n,), params)

    def begin(draws: Any, key: PRNGKeyArray) -> Any:
        state = env.begin(draws, params)
        uniform = jax.random.uniform(key, (2,))
        anywhere = uniform[1] * jnp.maximum(params.tunnel.pick(state.tunnel).length - room, 0.0)
        station = jnp.where(uniform[0] < _AS_THE_TASK, jnp.nan, anywhere)
        return env.begin({**draws, "choice": Choice(station=station)}, params)

    return jax.vmap(begin)(draws, jax.random.split(keys[1], n))


def _pace(key: PRNGKeyArray) -> Float[Array, "4"]:
    """Draws how a robot drives: mean fraction of full speed, swing, period in steps, phase."""
    u = jax.random.uniform(key, (5,))
    mean = _SLOWEST + (1.0 - _SLOWEST) * u[1]
    mean, swing = jnp.where(u[0] < _FULL, 1.0, mean), jnp.where(u[0] < _FULL, 0.0, 0.2 * u[2])
    return jnp.stack([mean, swing, 50.0 + 200.0 * u[3], 6.28 * u[4]])


def _speed(pace: Float[Array, "4"], t: Array) -> Float[Array, ""]:
    """Returns the fraction of full speed at step `t`."""
    return jnp.clip(pace[0] + pace[1] * jnp.sin(6.28 * t / pace[2] + pace[3]), 0.2, 1.0)
