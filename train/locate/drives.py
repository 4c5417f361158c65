"""Drives to learn from: along the axis at speeds that vary, from anywhere, with the truth beside them.

Round boxes the written avoidance steers, as in the agent; in training also faster than it does there.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.baselines.agent import observed
from subterra_jax.baselines.avoidance import steering_of
from subterra_jax.baselines.steering import CentreLine
from subterra_jax.policies.locate.bends import look as look_at
from subterra_jax.policies.locate.streams import Record
from subterra_jax.rules.rule import Choice

_FULL = 0.6  # share of drives at full speed
_AT_MOUTH = 0.4  # share of drives that start at the mouth, as the task does
_SLOWEST = 0.5  # of full speed


@struct.dataclass
class Drive:
    """Drives of a batch.

    Attributes:
        record: As the robots saw them.
        moved: True distance along the axis since the start, m.
        start: True station of the start, m.
        tunnel: Number of the tunnel.
    """

    record: Record
    moved: Float[Array, "env time"]
    start: Float[Array, "env"]
    tunnel: Float[Array, "env"]


def record_drives(
    env: Any,
    params: Any,
    key: PRNGKeyArray,
    n_envs: int,
    n_steps: int,
    from_mouth: bool = False,
    speed: float | None = None,
) -> Drive:
    """Drives `n_envs` robots for `n_steps` steps; a robot that meets the end stands there.

    Args:
        env: The environment of a task that starts facing growing stations.
        params: Its parameters.
        key: Source of everything random.
        n_envs: Number of robots.
        n_steps: Number of steps.
        from_mouth: All start at the mouth and drive at full speed, as an agent does.
        speed: The full speed, m/s; None is that of the vehicle.
    """
    keys = jax.random.split(key, 4)
    speed_max = params.vehicle.speed_max if speed is None else speed
    room = speed_max * params.vehicle.period * n_steps * 1.1 + 20.0
    state = _starts(env, params, keys, n_envs, room, from_mouth)
    pace = jax.vmap(_pace)(jax.random.split(keys[2], n_envs))

    def look(state: Any, noise: Any) -> Any:
        return observed(env, params, env.observe(state, noise, params))

    first = env.draw_step(keys[3], (n_envs,), params)
    seen = jax.vmap(look)(state, first)
    steering = _steerings(steering_of(params, CentreLine()), keys[2], n_envs, speed_max, from_mouth)
    walls = jax.vmap(lambda s, obs: s.begin(obs, params))(steering, seen)
    command, driven, over = jnp.zeros((n_envs, 2)), jnp.zeros(n_envs), jnp.zeros(n_envs, bool)
    bend = jnp.zeros(n_envs)

    def step(carry: Any, t: Array) -> Any:
        state, seen, walls, command, driven, over, bend = carry
        walls = jax.vmap(lambda s, w, obs, c: s.look(w, obs, c, params))(steering, walls, seen, command)
        moved = command[:, 0] * params.vehicle.period * jax.vmap(lambda s, w: s.cosine(w))(steering, walls)
        driven = driven + moved
        sides = getattr(walls, "corridor", walls)
        points, bend = jax.vmap(lambda b, obs, w, m: look_at(b, obs, w, m, params))(bend, seen, sides, moved)
        kept = Record(driven, seen.distance, points), state.station
        share = jnp.where(from_mouth, 1.0, jax.vmap(lambda p: _speed(p, t))(pace))
        end = jax.vmap(lambda s: params.tunnel.pick(s.tunnel).length)(state) - 5.0
        over = over | (state.station > end)
        wanted = jnp.where(over, 0.0, share * speed_max)
        command = jax.vmap(lambda s, w, v: s.steer(w, v, params))(steering, walls, wanted)
        command = jnp.where(over[:, None], 0.0, command)
        noise = env.draw_step(jax.random.fold_in(keys[3], t + 1), (n_envs,), params)
        action = jnp.pad(command, ((0, 0), (0, env.action_size - 2)))
        state = jax.vmap(lambda s, a, z: env.advance(s, a, z, params)[0])(state, action, noise)
        seen = jax.vmap(look)(state, noise)
        return (state, seen, walls, command, driven, over, bend), kept

    start = state.station
    carry: Any = (state, seen, walls, command, driven, over, bend)
    (state, *_), (record, station) = jax.lax.scan(step, carry, jnp.arange(n_steps))
    record = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), record)
    return Drive(record, jnp.swapaxes(station, 0, 1) - start[:, None], start, state.tunnel)


def _starts(env: Any, params: Any, keys: Array, n: int, room: Any, from_mouth: bool) -> Any:
    """Returns states to drive from: some where the task starts, the others anywhere with `room` m before them."""
    draws = env.draw_reset(keys[0], (n,), params)

    def begin(draws: Any, key: PRNGKeyArray) -> Any:
        state = env.begin(draws, params)
        uniform = jax.random.uniform(key, (2,))
        anywhere = uniform[1] * jnp.maximum(params.tunnel.pick(state.tunnel).length - room, 0.0)
        station = jnp.where((uniform[0] < _AT_MOUTH) | from_mouth, jnp.nan, anywhere)
        return env.begin({**draws, "choice": Choice(station=station)}, params)

    return jax.vmap(begin)(draws, jax.random.split(keys[1], n))


def _steerings(steering: Any, key: PRNGKeyArray, n: int, speed_max: Any, as_it_is: bool) -> Any:
    """Returns a steering for each robot: the same, but that one round boxes drives up to a speed of its own."""
    fields = {
        field.name: jnp.broadcast_to(getattr(steering, field.name), (n,)) for field in dataclasses.fields(steering)
    }
    if "speed" in fields and not as_it_is:
        share = jax.random.uniform(jax.random.fold_in(key, 1), (n,))
        fields["speed"] = steering.speed + share * (speed_max - steering.speed)
    return dataclasses.replace(steering, **fields)


def _pace(key: PRNGKeyArray) -> Float[Array, "4"]:
    """Draws how a robot drives: mean share of full speed, swing, period in steps, phase."""
    u = jax.random.uniform(key, (5,))
    mean = _SLOWEST + (1.0 - _SLOWEST) * u[1]
    mean, swing = jnp.where(u[0] < _FULL, 1.0, mean), jnp.where(u[0] < _FULL, 0.0, 0.2 * u[2])
    return jnp.stack([mean, swing, 50.0 + 200.0 * u[3], 6.28 * u[4]])


def _speed(pace: Float[Array, "4"], t: Array) -> Float[Array, ""]:
    """Returns the share of full speed at step `t`."""
    return jnp.clip(pace[0] + pace[1] * jnp.sin(6.28 * t / pace[2] + pace[3]), 0.2, 1.0)
