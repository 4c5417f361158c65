"""The fused LiDAR, here in Pallas' interpreter; on a GPU `benchmarks.throughput` holds it against the reference."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import lidar
from subterra_jax.lidar import fused, reference
from subterra_jax.tunnel import Tunnel, node_at


@pytest.fixture(scope="module")
def plan() -> st.TunnelPlan:
    return st.load_tunnel().slice(100.0, 60.0)


def fused_scan(tunnel: Tunnel, poses: reference.Poses, wanted: np.ndarray, n_beams: int, range_max: float = 30.0):
    first = tunnel.scan_first[jax.vmap(node_at, (None, 0))(tunnel, jnp.asarray(poses.station))]
    return np.asarray(
        fused.scan(
            tunnel,
            jnp.asarray(poses.position),
            jnp.asarray(poses.heading),
            first,
            jnp.asarray(wanted),
            jnp.float32(range_max),
            lidar.bearings(n_beams),
        )
    )


@pytest.mark.parametrize("n_beams", [2, 12, 16])
def test_the_kernels_give_the_ranges_of_the_reference(plan: st.TunnelPlan, n_beams: int) -> None:
    poses = reference.random_poses(plan, 70, np.random.default_rng(n_beams))
    tunnel = Tunnel.from_plan(plan)
    ranges = fused_scan(tunnel, poses, np.ones(70, bool), n_beams)
    assert ranges.shape == (70, n_beams)
    assert reference.agreement(plan.lining("pockets").segments, poses, ranges).n_wrong == 0


def test_the_kernels_clip_at_the_largest_range(plan: st.TunnelPlan) -> None:
    poses = reference.random_poses(plan, 32, np.random.default_rng(1))
    ranges = fused_scan(Tunnel.from_plan(plan), poses, np.ones(32, bool), 16, range_max=4.0)
    assert ranges.max() == 4.0
    assert ranges.min() < 4.0


def test_wanted_scans_do_not_depend_on_the_unwanted_ones(plan: st.TunnelPlan) -> None:
    poses = reference.random_poses(plan, 96, np.random.default_rng(2))
    tunnel, wanted = Tunnel.from_plan(plan), np.arange(96) == 50
    some, everything = (fused_scan(tunnel, poses, mask, 16) for mask in (wanted, np.ones(96, bool)))
    np.testing.assert_array_equal(some[50], everything[50])
