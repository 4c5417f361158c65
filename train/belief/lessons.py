"""Lessons: a stretch driven by the controller, and the ways along the tunnel that it might have been."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from subterra_jax.baselines.agent import Observed, observed
from subterra_jax.baselines.steering import CentreLine, Corridor

_NEAR = 1.5  # m: up to here a wrong way is a near one
_PHASE_SIGMA = 0.1  # m about whole rings from the true way


@struct.dataclass
class Drive:
    """State of the environments between two unrolls.

    Attributes:
        env_state: State of the batch of environments.
        observation: To act upon next.
        walls: Walls tracked in each.
        command: Last command of each, m/s and rad/s.
        first: The observation begins an episode.
    """

    env_state: Any
    observation: Float[Array, "env obs"]
    walls: Corridor
    command: Float[Array, "env 2"]
    first: Bool[Array, "env"]


@struct.dataclass
class Stretch:
    """Storage of one unroll, `(time, env, …)`.

    Attributes:
        ranges: Scans, m.
        walls: Walls as tracked.
        station: True station, m.
        forward: 1 where the robot faces growing stations, else −1.
        tunnel: Index of the tunnel in a stack.
        same: No episode has ended since the stretch began.
    """

    ranges: Float[Array, "time env n_beams"]
    walls: Corridor
    station: Float[Array, "time env"]
    forward: Float[Array, "time env"]
    tunnel: Int[Array, "time env"]
    same: Bool[Array, "time env"]


@struct.dataclass
class Ways:
    """Ways along a tunnel, the true one first.

    Attributes:
        station: Station at each time, m.
        forward: 1 where one faces growing stations, else −1.
        wrong: To take it for the true way would be a mistake.
    """

    station: Float[Array, "time way"]
    forward: Float[Array, "way"]
    wrong: Bool[Array, "way"]


def begin(env: Any, params: Any, key: PRNGKeyArray, n_envs: int) -> Drive:
    """Starts an episode in every environment."""
    observation, state = env.reset(key, params, n_envs)
    walls = jax.vmap(lambda seen: CentreLine().begin(_observe(env, params, seen), params))(observation)
    return Drive(state, observation, walls, jnp.zeros((n_envs, 2)), jnp.ones(n_envs, bool))


def collect(env: Any, params: Any, drive: Drive, key: PRNGKeyArray, n_steps: int) -> tuple[Drive, Stretch]:
    """Drives on along the axis at full speed; a robot that comes to an end begins anew somewhere else."""

    def look(walls: Corridor, seen: Array, command: Array, first: Array) -> Corridor:
        obs = _observe(env, params, seen)
        fresh, tracked = CentreLine().begin(obs, params), CentreLine().look(walls, obs, command, params)
        return jax.tree.map(lambda new, old: jnp.where(first, new, old), fresh, tracked)

    def step(carry: tuple[Drive, Array], key_now: PRNGKeyArray) -> tuple[tuple[Drive, Array], Stretch]:
        now, same = carry
        walls = jax.vmap(look)(now.walls, now.observation, now.command, now.first)
        command = jax.vmap(lambda w: CentreLine().steer(w, jnp.asarray(params.vehicle.speed_max), params))(walls)
        action = jnp.pad(command, ((0, 0), (0, env.env.action_size - 2)))
        known = jax.vmap(env.env.privileged, (0, None))(now.env_state, params)
        stored = Stretch(
            ranges=now.observation[:, env.env.fields(params)["ranges"]],
            walls=walls,
            station=now.env_state.station,
            forward=jnp.where(known["heading_cos"] > 0.0, 1.0, -1.0),
            tunnel=now.env_state.tunnel,
            same=same,
        )
        observation, state, _, terminated, truncated, _ = env.step(key_now, now.env_state, action, params)
        done = terminated | truncated
        return (Drive(state, observation, walls, command, done), same & ~done), stored

    fresh = jnp.ones(len(drive.first), bool)
    (after, _), stored = jax.lax.scan(step, (drive, fresh), jax.random.split(key, n_steps))
    return after, stored


def ways(
    key: PRNGKeyArray,
    station: Float[Array, "time"],
    forward: Float[Array, ""],
    length: Float[Array, ""],
    pitch: Float[Array, ""],
    n: int,
    least_apart: float,
    jitter: float,
) -> Ways:
    """Draws `n` ways beside the true one; they are as long and begin elsewhere.

    Three eighths of them face as the robot does, a whole number of rings away; one eighth begin up to 1.5 m off; the
    others face the other way.

    Args:
        key: Source of the draws.
        station: True station at each time, m.
        forward: 1 where the robot faces growing stations, else −1.
        length: Length of the tunnel, m.
        pitch: Between rings, m; 0 where there are none.
        n: Number of other ways.
        least_apart: Nearer ways than this are no mistake, m.
        jitter: The true way is off by up to this, m, as a cell of the filter would be.
    """
    key_where, key_sign, key_phase, key_true = jax.random.split(key, 4)
    index = jnp.arange(n)
    tape = jnp.where(forward > 0.0, station, length - station)
    apart = length * jax.random.uniform(key_where, (n,)) - tape[0]
    whole = jnp.where(pitch > 0.0, jnp.round(apart / jnp.maximum(pitch, 0.1)) * pitch, apart)
    rings_away = whole + _PHASE_SIGMA * jax.random.normal(key_phase, (n,))
    sign = jnp.where(jax.random.bernoulli(key_sign, 0.5, (n,)), 1.0, -1.0)
    near = sign * (least_apart + (_NEAR - least_apart) * jnp.mod(jnp.abs(apart), 1.0))
    turned = index % 2 == 1
    shift = jnp.where(turned, apart, jnp.where(index % 8 == 0, near, rings_away))
    own = jitter * jax.random.uniform(key_true, (1,), minval=-1.0)
    shift = jnp.concatenate([own, shift])
    facing = forward * jnp.concatenate([jnp.ones(1), jnp.where(turned, -1.0, 1.0)])
    place = tape[:, None] + shift
    return Ways(
        station=jnp.where(facing > 0.0, place, length - place),
        forward=facing,
        wrong=(facing != forward) | (jnp.abs(shift) >= least_apart),
    )


def _observe(env: Any, params: Any, observation: Float[Array, "obs"]) -> Observed:
    return observed(env.env, params, observation)
