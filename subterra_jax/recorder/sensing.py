"""What further sensors would have seen from the poses of an episode: a dense planar LiDAR, one in three dimensions."""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from subterra_jax import lidar3d
from subterra_jax.env import TunnelEnv
from subterra_jax.lidar3d import Relief
from subterra_jax.recorder.drive import Trace
from subterra_jax.recorder.poses import Poses
from subterra_jax.state import EnvParams, State

CLOUD_RANGE = 100.0  # m
CLOUD_SIGMA = 0.01  # m. Source: VLP-16 user manual, "up to ±3 cm (typical)", taken as three standard deviations
_SCANS = 128  # planar scans in one go
_RAYS = 200_000  # of clouds in one go
_DENSE_STREAM = 0x5CA7  # a key of its own: the episode's draws are not touched


def dense_scans(
    trace: Trace, env: TunnelEnv, params: EnvParams, n_beams: int, seed: int
) -> Float[np.ndarray, "n n_beams"]:
    """Planar scans of more beams, with the same range, noise, boxes and faults as the task's own.

    A sector that drops out is as wide as that of the task's LiDAR.

    Args:
        trace: The episode.
        env: Its environment.
        params: Its task.
        n_beams: Beams, the first straight ahead, the others counter-clockwise.
        seed: Of the episode.
    """
    n, wider = len(trace.observation), n_beams / params.lidar.n_beams
    dense = params.replace(lidar=dataclasses.replace(params.lidar, n_beams=n_beams))
    state = trace.state.replace(
        **{part.name: part.with_beams(trace.state.parts[part.name], wider) for part in env.parts}
    )
    key = jax.random.fold_in(jax.random.key(jnp.uint32(seed)), _DENSE_STREAM)
    rows = np.minimum(np.arange(-(-n // _SCANS) * _SCANS), n - 1).reshape(-1, _SCANS)
    parts = [_perceive(env, jax.tree.map(lambda leaf, some=some: leaf[some], state), key, some, dense) for some in rows]
    return np.concatenate([np.asarray(part) for part in parts])[:n]


@functools.partial(jax.jit, static_argnums=0)
def _perceive(env: TunnelEnv, state: State, key: Array, index: Array, params: EnvParams) -> Float[Array, "n n_beams"]:
    def one(state: State, index: Array) -> Array:
        noise = env.draw_step(jax.random.fold_in(key, index), (), params)
        return env.observe(state, noise, params)[env.fields(params)["ranges"]]

    return jax.vmap(one)(state, index)


def clouds(
    relief: Relief, poses: Poses, station: Float[np.ndarray, " n"], directions: Float[np.ndarray, "m 3"], seed: int
) -> Iterator[Float[np.ndarray, " m"]]:
    """Noisy ranges of each sweep, m; NaN where a beam met nothing within `CLOUD_RANGE`.

    A sweep is taken at one instant: the robot's motion during a turn of the head is not simulated.

    Args:
        relief: The bore's surface.
        poses: Of the LiDAR in the tunnel frame.
        station: Of the LiDAR, m.
        directions: Its beams.
        seed: Of the noise: sweep k depends on the seed and k alone.
    """
    size = max(1, min(len(poses), _RAYS // len(directions)))
    beams = jnp.asarray(directions, jnp.float32)
    quaternion = poses.rotation.as_quat()[:, [3, 0, 1, 2]]
    for first in range(0, len(poses), size):
        # The last batch is filled up, so that all have one shape.
        rows = np.minimum(np.arange(first, first + size), len(poses) - 1)
        there = (np.asarray(values[rows], np.float32) for values in (poses.position, quaternion, station))
        ranges = np.asarray(_cast()(relief, *there, beams, CLOUD_RANGE))
        for k in range(first, min(first + size, len(poses))):
            noise = np.random.default_rng([seed, k]).normal(0.0, CLOUD_SIGMA, len(directions))
            found = ranges[k - first]
            yield np.where(found < CLOUD_RANGE, found + noise, np.nan).astype(np.float32)


@functools.cache
def _cast() -> Any:
    return jax.jit(jax.vmap(lidar3d.scan, in_axes=(None, 0, 0, 0, None, None)))
