"""Planar tunnels raised upright: level beams agree with the planar LiDAR, others with the floor and the crown."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import subterra_jax as st
from benchmarks import reference
from subterra_jax import lidar3d
from tests.subterra_jax import surfaces

N = 64


@pytest.fixture(scope="module")
def family() -> tuple[list[st.TunnelPlan], lidar3d.Relief]:
    plans = [st.load_tunnel(f"open:val:{i}").slice(20.0, 90.0) for i in range(4)]
    plans = [dataclasses.replace(plan, elevation=0.0 * plan.elevation) for plan in plans]
    return plans, lidar3d.stack_reliefs([lidar3d.Relief.from_plan(plan) for plan in plans])


def scans(relief: lidar3d.Relief, which: np.ndarray, poses: reference.Poses, height: float, beam: np.ndarray):
    ways = np.float32([Rotation.from_euler("z", heading).apply(beam) for heading in poses.heading])
    place = np.column_stack([poses.position, np.full(len(ways), height)]).astype(np.float32)
    one = lambda k, *rest: surfaces.ranges(relief.pick(k), *rest)  # noqa: E731
    return np.asarray(jax.jit(jax.vmap(one))(which, place, ways, poses.station))


def test_beams_up_and_down_meet_crown_and_floor(family) -> None:
    plans, relief = family
    poses = reference.random_poses(plans[1], N, np.random.default_rng(9))
    beam = np.float32([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    ranges = scans(relief, np.ones(N, int), poses, 0.7, beam)
    np.testing.assert_allclose(ranges, np.tile([5.3, 0.7], (N, 1)), atol=1e-4)


def test_a_packaged_tunnel_is_raised_along_its_grade_and_a_lidar_above_the_crown_is_refused() -> None:
    plan = dataclasses.replace(st.load_tunnel().slice(100.0, 40.0), shell=None)
    relief = lidar3d.Relief.from_plan(plan)
    assert sum(leaf.nbytes for leaf in jax.tree.leaves(relief)) < 2e6
    mid = len(plan.station) // 2
    place = jnp.asarray([*plan.centre[mid], plan.elevation[mid] + 1.0], jnp.float32)
    down = surfaces.ranges(relief, place, jnp.array([[0.0, 0.0, -1.0]]), jnp.float32(plan.station[mid]))
    np.testing.assert_allclose(down, [1.0], atol=1e-3)
    with pytest.raises(st.SubterraError, match=r"below the assumed crown at 6 m, is at 6.5 m"):
        lidar3d.Relief.from_plan(dataclasses.replace(plan, lidar_height=6.5))
