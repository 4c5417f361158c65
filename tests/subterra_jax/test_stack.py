"""Several tunnels in one: each behaves as it does alone, whichever others are beside it."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from benchmarks import reference
from subterra_jax import lidar
from subterra_jax.lidar import gpu, kernels, planar
from subterra_jax.parts import unicycle as vehicle
from subterra_jax.tunnel import Tunnel, foot, node_at
from subterra_jax.tunnel.tunnel import stack
from tests.subterra_jax import tunnels

PARAMS = lidar.LidarParams()
LININGS = ("pockets", "smooth", "furnished")


@pytest.fixture(scope="module")
def plans(plan_of) -> list[st.TunnelPlan]:
    """Tunnels that differ in length, width, bends and lining, the second shorter than a window."""
    packaged = st.load_tunnel()
    return [
        packaged.slice(100.0, 90.0),
        plan_of(tunnels.tunnel_arrays(tunnels.straight(24.0), half_width=3.0)),
        packaged.slice(200.0, 60.0),
    ]


@pytest.fixture(scope="module")
def alone(plans) -> list[Tunnel]:
    return [Tunnel.from_plan(plan, lining) for plan, lining in zip(plans, LININGS, strict=True)]


@pytest.fixture(scope="module")
def together(alone) -> Tunnel:
    return stack(alone)


@jax.jit
def look(tunnel: Tunnel, index, position, heading, station):
    """Scan, clearance and foot of many poses, each in the tunnel that it names."""

    def one(index, position, heading, station):
        mine = tunnel.pick(index)
        return (
            lidar.scan(mine, position, heading, station, PARAMS),
            vehicle.clearance(mine, position, station),
            foot(mine, position, station),
            mine.length,
            mine.ring_pitch,
        )

    return jax.vmap(one)(index, position, heading, station)


def poses_in(plans, n: int) -> list[reference.Poses]:
    rng = np.random.default_rng(0)
    return [
        reference.Poses(
            *(np.concatenate(pair) for pair in zip(vars(inner).values(), vars(outer).values(), strict=True))
        )
        for inner, outer in (
            (reference.random_poses(p, n, rng), reference.random_poses(p, n // 4, rng, near_mouths=True)) for p in plans
        )
    ]


def assert_same(one, other) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


def test_each_tunnel_of_a_stack_agrees_with_its_own_walls(plans, together):
    for i, (plan, lining, poses) in enumerate(zip(plans, LININGS, poses_in(plans, 400), strict=True)):
        ranges = look(together, jnp.full(len(poses.station), i), *vars(poses).values())[0]
        result = reference.agreement(plan.lining(lining).segments, poses, np.asarray(ranges))
        assert result.n_wrong == 0
        assert result.max_error < 1e-3


def test_the_kernels_of_a_gpu_see_each_tunnel_of_a_stack(plans, alone):
    poses = [reference.Poses(*(v[:24] for v in vars(p).values())) for p in poses_in(plans[:2], 30)]
    stacked = stack(alone[:2])
    position, heading, station = (np.concatenate(part) for part in zip(*(vars(p).values() for p in poses), strict=True))
    index, rows = np.repeat([0, 1], 24), (jnp.asarray(position), jnp.asarray(heading))
    start = jax.vmap(lambda i, s: stacked.visit_first[node_at(stacked.pick(i), s)])(index, station)
    ranges = gpu.scan(stacked.walls, *rows, start, jnp.ones(48, bool), jnp.float32(30.0), lidar.bearings(2))
    walls = [plan.lining(lining).segments for plan, lining in zip(plans, LININGS, strict=True)][:2]
    truth = [reference.scan(w, p.position, p.heading, 2) for w, p in zip(walls, poses, strict=True)]
    np.testing.assert_allclose(ranges, np.concatenate(truth), atol=1e-3)


def test_a_batch_of_different_tunnels_and_lidars_goes_to_the_kernels_as_rows(plans, together, monkeypatch):
    """Otherwise it would fall back to XLA on a GPU, which is several times slower there."""
    poses, index = poses_in(plans, 8)[0], jnp.arange(8) % 2 * 2
    params = lidar.LidarParams(range_max=jnp.linspace(5.0, 30.0, 8), range_sigma=jnp.linspace(0.0, 0.1, 8))

    def scans() -> jax.Array:
        one = lambda i, p, h, s, lidar_params: lidar.scan(together.pick(i), p, h, s, lidar_params)  # noqa: E731
        rows = (jnp.asarray(value[:8]) for value in vars(poses).values())
        return jax.jit(jax.vmap(one))(index, *rows, params)

    by_xla, kernel, calls = scans(), planar._cast_rows, []
    monkeypatch.setattr(planar, "_cast_rows", lambda *args: calls.append(args) or kernel(*args))
    monkeypatch.setattr(kernels, "present", lambda: True)
    np.testing.assert_allclose(scans(), by_xla, atol=1e-5)
    assert [call[1].shape for call in calls] == [(8, 2)]


def test_a_stack_of_one_is_that_one_and_picks_itself(alone):
    assert stack(alone[:1]) is alone[0]
    assert alone[0].pick(0) is alone[0]
    assert (alone[0].count, stack(alone[:2]).count) == (1, 2)
    assert stack([alone[0], dataclasses.replace(alone[1], reach=20.0)]).reach == 20.0
    assert stack([alone[0], dataclasses.replace(alone[1], packed=None)]).packed is None  # XLA casts there


def test_an_empty_stack_and_a_stack_of_stacks_are_refused(alone, together):
    with pytest.raises(ValueError, match="at least one"):
        stack([])
    with pytest.raises(ValueError, match="tunnel 1 is a stack of 3"):
        stack([alone[0], together])


def test_padding_is_never_taken_for_a_wall(plan_of):
    """A beam at exactly 45° from a point with x = y looks straight at where padding is."""
    tunnel = Tunnel.from_plan(plan_of(tunnels.tunnel_arrays(tunnels.straight(6.0))), "smooth")
    ranges = jax.jit(partial(lidar.scan, params=PARAMS))(
        tunnel, jnp.array([2.0, 2.0]), jnp.float32(0.0), jnp.float32(2.0)
    )
    assert float(ranges[2]) == pytest.approx(0.825 * 2**0.5, abs=1e-5)
