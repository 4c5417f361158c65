"""Robots drawn and driven by the thousand without scans, and what their numbers are held against."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import subterra_jax as st
from subterra_jax.parts import FaultParams
from subterra_jax.tunnel import at_station

SPEED, PERIOD = 2.0, 0.1
MANY, FEW = 3000, 400  # robots; two sizes only, or each would be compiled anew


@functools.cache
def made(id):
    """A task, its functions for batches of robots compiled once. Faults have the middle of their sizes."""
    middle = {"faults": FaultParams(spread=0.0)} if "Faulted" in id else {}
    env, params = st.make(id, tunnel="subterra-351", **middle)
    begin = jax.jit(lambda key: jax.vmap(env.begin, (0, None))(env.draw_reset(key, (MANY,), params), params))

    @jax.jit
    def advance(key, state, action):
        draws = env.draw_step(key, (len(action),), params)
        return jax.vmap(env.advance, (0, 0, 0, None))(state, action, draws, params)

    @jax.jit
    def observe(key, state):
        return jax.vmap(env.observe, (0, 0, None))(state, env.draw_step(key, state.station.shape, params), params)

    return env, params, begin, advance, observe


def fresh(id, n, key=0):
    """States of n robots at the start of their episodes, the first of `MANY`."""
    return jax.tree.map(lambda leaf: leaf[:n], _begun(id, key))


@functools.cache
def _begun(id, key):
    return jax.device_get(made(id)[2](jax.random.key(key)))


@functools.partial(jax.jit, static_argnums=0)
def known(env, state, params):
    """Returns the true state of each robot, which observations hide."""
    return jax.vmap(env.privileged, (0, None))(state, params)


def advanced(id, state, action, key=0):
    """States, rewards, flags and infos of all robots after one step of an action, or of one action each."""
    env, _, _, advance, _ = made(id)
    numbers = np.zeros((len(state.station), env.action_size), np.float32)
    numbers[:, : np.shape(action)[-1]] = action
    return advance(jax.random.key(key), state, numbers)


def observed(id, state, key=0):
    """Observations of all robots, by name."""
    env, params, *_, observe = made(id)
    flat = np.asarray(observe(jax.random.key(key), state))
    return {name: flat[:, part] for name, part in env.fields(params).items()}


def placed(id, state, station, lateral=0.0, backward=False):
    """The robots put down elsewhere, along the axis."""
    shape = state.station.shape
    station, lateral = (np.broadcast_to(np.asarray(values, np.float32), shape) for values in (station, lateral))
    position, heading = _place(made(id)[1].tunnel, station, lateral, np.float32(-1.0 if backward else 1.0))
    return state.replace(position=position, heading=heading, station=station, lateral=lateral)


@jax.jit
def _place(tunnel, station, lateral, way):
    """Positions and headings along the axis."""
    x, y, along, across, _ = jax.vmap(at_station, (None, 0), 1)(tunnel, station)
    return jnp.stack([x - lateral * across, y + lateral * along], axis=-1), jnp.arctan2(way * across, way * along)


@functools.partial(jax.jit, static_argnums=0)
def _driven_10_metres(env, params, state, key):
    """Fifty steps, and what happened in each."""

    def step(state, key):
        known = jax.vmap(env.privileged, (0, None))(state, params)
        side = jnp.sign(known["heading_cos"])
        yaw_rate = -side * (0.25 * known["lateral"] + 1.4 * known["heading_sin"])
        action = jnp.zeros((len(side), env.action_size)).at[:, 0].set(SPEED).at[:, 1].set(jnp.clip(yaw_rate, -0.7, 0.7))
        draws = env.draw_step(key, (len(side),), params)
        after, _, terminated, _, info = jax.vmap(env.advance, (0, 0, 0, None))(state, action, draws, params)
        row = {
            "moved": jnp.sqrt(jnp.sum((after.position - state.position) ** 2, axis=-1)),
            "counted": after.odometry.distance - state.odometry.distance,
            "turned": (after.heading - state.heading + jnp.pi) % (2.0 * jnp.pi) - jnp.pi,
            "asked": after.command[:, 1] * PERIOD,
            "station": state.station,
            "contact": info["contact"],
            "success": info["success"],
            "terminated": terminated,
        }
        return after, row

    return jax.lax.scan(step, state, jax.random.split(key, 50))


def driven(id, state, n_steps, key=1):
    """The robots after a drive at full speed along the axis, and series `(n_steps, n)`; contact does not stop them."""
    env, params, *_ = made(id)
    parts = []
    for k in range(n_steps // 50):
        state, part = _driven_10_metres(env, params, state, jax.random.key(1000 * key + k))
        parts.append(jax.device_get(part))
    return state, {name: np.concatenate([part[name] for part in parts]).astype(np.float64) for name in parts[0]}


def assert_mean(sample, expected):
    """The mean of independent numbers is the expected one, within four standard errors."""
    sample = np.asarray(sample, np.float64)
    error = sample.std(ddof=1) / np.sqrt(len(sample))
    assert abs(sample.mean() - expected) < 4.0 * error, f"{sample.mean():.6g}, expected {expected:.6g} ± {error:.2g}"


def assert_covariance(a, b, expected):
    """The covariance of two samples of mean 0 is the expected one, within four standard errors."""
    assert_mean(np.asarray(a, np.float64) * np.asarray(b, np.float64), expected)


def stand(id, state, steps, report=None):
    """The robots after they were asked to stand, and the info of the last step."""
    n = len(state.station)
    action = (
        np.zeros((n, 2))
        if report is None
        else np.stack([*np.zeros((2, n)), report, *np.tile([0.0, 1.0], (n, 1)).T], -1)
    )
    for k in range(steps):
        state, gain, terminated, _, info = advanced(id, state, action, key=100 + k)
    return state, np.asarray(gain), np.asarray(terminated), {name: np.asarray(value) for name, value in info.items()}
