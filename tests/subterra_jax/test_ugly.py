"""A hundred random tunnels with rough walls, folds, undercut niches and loops: exact, or refused in one sentence."""

from functools import partial

import jax
import numpy as np

import subterra_jax as st
from benchmarks import reference
from subterra_jax import lidar
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.tunnel import stack


def ugly_walls(rng: np.random.Generator) -> list[np.ndarray]:
    n = rng.integers(60, 160)
    station = np.linspace(0, rng.uniform(30, 70), n)
    turn = rng.normal(0, rng.choice([0, 0.02, 0.08]), n).cumsum() * 0.1
    heading = np.cumsum(np.clip(turn, -0.1, 0.1))
    tangent = np.stack([np.cos(heading), np.sin(heading)], -1)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], -1)
    centre = np.cumsum(tangent * np.gradient(station)[:, None], axis=0)
    width, fold, rough = rng.uniform(1.5, 3.5), rng.choice([0.0, 0.3, 0.8, 1.5]), rng.choice([0.02, 0.2, 0.5])
    walls = []
    for side in (1, -1):
        wall = centre + side * normal * (width + np.abs(rng.normal(0, rough, n)))[:, None]
        wall = wall + tangent * (rng.uniform(-fold, fold, n) * (rng.random(n) < 0.3))[:, None]
        for k in rng.integers(5, n - 5, rng.integers(0, 4)):
            depth, length = rng.uniform(0.3, 2.5), rng.uniform(0.2, 2.0)
            mouth = 0.5 * length if rng.random() < 0.5 else length
            niche = np.array([[0, 0], [0.2 * length, depth], [length, depth], [mouth, 0]])
            niche = wall[k] + niche @ np.stack([tangent[k], side * normal[k]])
            wall = np.concatenate([wall[:k], niche, wall[k + 1 :]])
        walls.append(wall)
    return walls


def test_ugly_tunnels_are_exact_or_refused_in_one_sentence():
    seeds, plans, poses, refusals = [], [], [], []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        try:
            plans.append(st.tunnel.from_polylines(*ugly_walls(rng)))
        except st.TunnelError as error:
            refusals.append(str(error))
            continue
        seeds.append(seed)
        poses.append(reference.random_poses(plans[-1], 400, rng, gap=0.45))
    assert 20 < len(plans) < 60
    assert not any("\n" in refusal for refusal in refusals)
    tunnels = stack([Tunnel.from_plan(plan) for plan in plans])

    @partial(jax.jit, static_argnums=0)
    @partial(jax.vmap, in_axes=(None, None, 0, 0, 0, 0))
    def scan(fused, tunnels, index, position, heading, station):
        return lidar.scan(tunnels.pick(index), position, heading, station, lidar.LidarParams(fused=fused))

    rows = [np.concatenate(part) for part in zip(*(vars(each).values() for each in poses), strict=True)]
    index = np.repeat(np.arange(len(plans)), 400)
    for fused in (True, False):
        ranges = np.asarray(scan(fused, tunnels, index, *rows)).reshape(len(plans), 400, 16)
        for seed, plan, own, found in zip(seeds, plans, poses, ranges, strict=True):
            result = reference.agreement(plan.lining("smooth").segments, own, found)
            assert result.n_wrong == 0, (fused, seed, result)
