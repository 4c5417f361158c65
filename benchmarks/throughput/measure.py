"""Loops to time: our environment, and the least that one of its shape must do; and the exactness of its LiDAR."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

import subterra_jax as st
from benchmarks.rays import planar as reference
from benchmarks.throughput.timing import Carry, Loop, digest


def environment_loop(env: st.TunnelEnv, params: st.EnvParams, n_envs: int) -> Loop:
    """Returns the loop of `AutoReset` under random actions, with LiDAR, noise, reward, contact and resets."""
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
    """Returns the same loop with robots spread along the tunnel, short of the goal, as a trained policy's would be."""
    loop = environment_loop(env, params, n_envs)

    def reset(key: PRNGKeyArray, params: st.EnvParams) -> Carry:
        station_key, reset_key = jax.random.split(key)
        last = 0.8 * params.goal_coverage * params.tunnel.length
        station = jax.random.uniform(station_key, (n_envs,), maxval=last)

        def one(key: PRNGKeyArray, station: Array) -> Carry:
            start: Any = params.start
            return env.reset(key, params.replace(start=start.replace(station=station)))

        return jax.vmap(one)(jax.random.split(reset_key, n_envs), station)

    return dataclasses.replace(loop, reset=reset)


def floor_loop(loop: Loop) -> Loop:
    """Returns the least that a batched environment of this shape does: draw actions, read and write its arrays.

    Nothing is simulated. Its speed is the limit that kernel launches and memory set on a machine.
    """

    def step(key: PRNGKeyArray, carry: Carry, params: Any) -> tuple[Carry, Array, Array]:
        n_envs = jax.tree.leaves(carry)[0].shape[0]
        action = jax.random.uniform(key, (n_envs, 2), minval=-1e-3, maxval=1e-3)

        def change(leaf: Array) -> Array:
            if not jnp.issubdtype(leaf.dtype, jnp.floating):
                return ~leaf
            return leaf + action[:, 0].reshape(n_envs, *[1] * (leaf.ndim - 1))

        return jax.tree.map(change, carry), digest(action), jnp.zeros(())

    return dataclasses.replace(loop, step=step)


def measure_exactness(
    plan: st.TunnelPlan, lining: str, params: st.EnvParams, n_poses: int, seed: int
) -> reference.Agreement:
    """Compares the LiDAR on this device with float64 brute force over every segment of the same walls.

    Args:
        plan: Whole tunnel.
        lining: Variant of its walls.
        params: Params of an environment made of that plan and lining.
        n_poses: Random poses, 16 rays each.
        seed: Seed for the poses.
    """
    poses = reference.random_poses(plan, n_poses, np.random.default_rng(seed))
    ranges = reference.simulate(params.tunnel, poses, params.lidar)
    return reference.agreement(plan.lining(lining).segments, poses, ranges)


def measure_exactness_of_many(
    names: list[str], lining: str | None, params: st.EnvParams, n_poses: int, seed: int
) -> reference.Agreement:
    """Compares the LiDAR in several tunnels that are in memory together, each as `measure_exactness` does.

    Args:
        names: Names of the tunnels.
        lining: Variant of their walls; None is the usual one of each.
        params: Params of an environment made of these tunnels, in this order.
        n_poses: Random poses, spread over the tunnels.
        seed: Seed for the poses.
    """
    found = []
    for index, name in enumerate(names):
        plan, here = st.load_tunnel(name), params.replace(tunnel=params.tunnel.pick(index))
        found.append(
            measure_exactness(plan, lining or plan.default_lining, here, -(-n_poses // len(names)), seed + index)
        )
    return reference.Agreement(
        n_rays=sum(each.n_rays for each in found),
        max_error=max(each.max_error for each in found),
        n_ambiguous=sum(each.n_ambiguous for each in found),
        n_wrong=sum(each.n_wrong for each in found),
    )
