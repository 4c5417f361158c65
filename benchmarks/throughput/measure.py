"""Our environment as a loop to time, and what it could not be faster than on the same machine."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

import subterra_jax as st
from benchmarks.throughput.timing import Carry, Loop, digest

# One wall of the window of a brute-force cast: two products and a comparison at each end, and the intersection.
_SEGMENTS, _OPERATIONS = 300, 20
# Lanes × clock, 1/s. Source: 132 multiprocessors of 128 float32 lanes (CUDA C++ Programming Guide, compute capability
# 9.0) at the 1,980 MHz that the card reads under load.
_LANES = {"NVIDIA H200": 132 * 128 * 1.98e9}


def environment_loop(env: st.TunnelEnv, params: st.EnvParams, n_envs: int) -> Loop:
    """`AutoReset` under random actions: LiDAR, noise, odometry, reward, contact, reset and both observations."""
    batch = st.AutoReset(env)
    low, high = (jnp.asarray(bound) for bound in dataclasses.astuple(env.action_space(params)))

    def reset(key: PRNGKeyArray, params: st.EnvParams) -> Carry:
        return batch.reset(key, params, n_envs)

    def step(key: PRNGKeyArray, carry: Carry, params: st.EnvParams) -> tuple[Carry, Array, Array]:
        action_key, env_key = jax.random.split(key)
        action = jax.random.uniform(action_key, (n_envs, env.action_size), minval=low, maxval=high)
        obs, state, reward, terminated, truncated, info = batch.step(env_key, carry[1], action, params)
        rest = digest((reward, info["final_observation"]))
        return (obs, state), rest, jnp.mean(terminated | truncated, dtype=jnp.float32)

    return Loop(reset, step, params)


def spread_loop(env: st.TunnelEnv, params: st.EnvParams, n_envs: int) -> Loop:
    """The same from starts all along the tunnel, as a trained policy's robots would be, but short of the goal."""
    loop = environment_loop(env, params, n_envs)

    def reset(key: PRNGKeyArray, params: st.EnvParams) -> Carry:
        station_key, reset_key = jax.random.split(key)
        last = 0.8 * params.goal_coverage * params.tunnel.length
        station = jax.random.uniform(station_key, (n_envs,), maxval=last)

        def one(key: PRNGKeyArray, station: Array) -> Carry:
            return env.reset(key, params.replace(start=params.start.replace(station=station)))  # type: ignore[attr-defined]

        return jax.vmap(one)(jax.random.split(reset_key, n_envs), station)

    return dataclasses.replace(loop, reset=reset)


def floor_loop(loop: Loop) -> Loop:
    """The least that any batched environment of this shape does: draw actions, read and write state and observation.

    Nothing is simulated. What a machine makes of this is what launches and memory allow there.
    """

    def step(key: PRNGKeyArray, carry: Carry, params: Any) -> tuple[Carry, Array, Array]:
        n_envs = jax.tree.leaves(carry)[0].shape[0]
        action = jax.random.uniform(key, (n_envs, 2), minval=-1e-3, maxval=1e-3)

        def moved(leaf: Array) -> Array:
            if not jnp.issubdtype(leaf.dtype, jnp.floating):
                return ~leaf
            return leaf + action[:, 0].reshape(n_envs, *[1] * (leaf.ndim - 1))

        return jax.tree.map(moved, carry), digest(action), jnp.zeros(())

    return dataclasses.replace(loop, step=step)


def arithmetic_floor(device: str, n_beams: int) -> float | None:
    """Environment steps per second at which a brute-force cast of 300 segments a beam fills the device's lanes.

    Args:
        device: As JAX names its kind.
        n_beams: Beams in one scan.

    Returns:
        Steps per second; None for a device whose lanes and clock are not known here. A hierarchy may be faster.
    """
    return _LANES[device] / (n_beams * _SEGMENTS * _OPERATIONS) if device in _LANES else None
