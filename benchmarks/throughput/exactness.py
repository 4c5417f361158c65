"""The gate: fast rays count only if they are the right ones."""

from functools import partial

import jax
import numpy as np

import subterra_jax as st
from subterra_jax import lidar
from subterra_jax.lidar import reference

# Poses scanned at a time, so that memory does not grow with their number.
_BATCH = 1000


def measure_exactness(
    plan: st.TunnelPlan, lining: str, params: st.EnvParams, n_poses: int, seed: int
) -> reference.Agreement:
    """Compares the LiDAR on this device with float64 brute force over every segment of the same walls.

    Args:
        plan: The tunnel, whole.
        lining: Variant of its walls.
        params: An environment's, made of that plan and lining.
        n_poses: Random poses, 16 rays each.
        seed: Of the poses.
    """
    poses = reference.random_poses(plan, n_poses, np.random.default_rng(seed))
    scan = jax.jit(jax.vmap(partial(lidar.scan, params=params.lidar), in_axes=(None, 0, 0, 0)))
    ranges = [
        np.asarray(scan(params.tunnel, poses.position[rows], poses.heading[rows], poses.station[rows]))
        for rows in np.array_split(np.arange(n_poses), max(1, n_poses // _BATCH))
    ]
    return reference.agreement(plan.lining(lining).segments, poses, np.concatenate(ranges))
