"""The kernels for NVIDIA GPUs, here in Pallas' interpreter, against XLA's and against float64 brute force."""

import dataclasses
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from benchmarks import reference
from subterra_jax import lidar
from subterra_jax.lidar import gpu, kernels
from subterra_jax.parts import unicycle
from subterra_jax.tunnel import CONTACT_REACH, Tunnel, node_at
from tests.subterra_jax.modes import wide
from tests.subterra_jax.placing import for_nvidia

KINDS = ("straight:train", "cast:train", "sprayed:train", "masonry:train", "universal:test-unseen", "rock:test-unseen")
NAMES = [None, *(f"open:{kind}:0" for kind in KINDS)]
REACH = np.float32(CONTACT_REACH)


def stretch_of(name: str | None) -> st.TunnelPlan:
    return (st.load_tunnel(name) if name else st.load_tunnel()).slice(100.0, 60.0)


@pytest.fixture(scope="module")
def plan() -> st.TunnelPlan:
    return stretch_of(None)


nodes = jax.jit(jax.vmap(node_at, (None, 0)))  # eager code would compile every operation by itself


def scan_by_kernel(
    tunnel: Tunnel,
    poses: reference.Poses,
    expected: np.ndarray | None = None,
    n_beams: int = 16,
    range_max: float = 30.0,
) -> np.ndarray:
    expected = np.ones(len(poses.station), bool) if expected is None else expected
    rows = poses.position, poses.heading, poses.station, expected
    return np.asarray(_scan(tunnel, *rows, np.float32(range_max), n_beams))


@partial(jax.jit, static_argnames="n_beams")
def _scan(tunnel, position, heading, station, expected, range_max, n_beams):
    start = tunnel.visit_first[jax.vmap(node_at, (None, 0))(tunnel, station)]
    return gpu.scan(tunnel, position, heading, start, expected, range_max, lidar.bearings(n_beams))


@pytest.mark.parametrize("n_beams", [1, 12, 16])
def test_scans_are_those_of_the_reference(plan: st.TunnelPlan, n_beams: int) -> None:
    poses = reference.random_poses(plan, 70, np.random.default_rng(n_beams))
    ranges = scan_by_kernel(Tunnel.from_plan(plan), poses, n_beams=n_beams)
    assert ranges.shape == (70, n_beams)
    assert reference.agreement(plan.lining("pockets").segments, poses, ranges).n_wrong == 0


@pytest.mark.parametrize(("name", "lining"), [(NAMES[4], None), (NAMES[6], None), (None, "furnished")])
def test_deep_recesses_rock_and_furniture_are_met(name: str | None, lining: str | None) -> None:
    plan = stretch_of(name)
    lining = lining or plan.default_lining
    poses = reference.random_poses(plan, 500, np.random.default_rng(1))
    found = reference.agreement(
        plan.lining(lining).segments, poses, scan_by_kernel(Tunnel.from_plan(plan, lining), poses)
    )
    assert (found.n_wrong, found.max_error < 1e-3) == (0, True)


def test_ranges_are_clipped_at_the_largest(plan: st.TunnelPlan) -> None:
    poses = reference.random_poses(plan, 32, np.random.default_rng(1))
    ranges = scan_by_kernel(Tunnel.from_plan(plan), poses, range_max=4.0)
    assert ranges.max() == 4.0
    assert ranges.min() < 4.0


def test_needed_scans_do_not_depend_on_the_unneeded_ones(plan: st.TunnelPlan) -> None:
    poses = reference.random_poses(plan, 96, np.random.default_rng(2))
    tunnel = Tunnel.from_plan(plan)
    some, everything = (scan_by_kernel(tunnel, poses, mask) for mask in (np.arange(96) == 50, np.ones(96, bool)))
    np.testing.assert_array_equal(some[50], everything[50])


def test_a_tunnel_whose_walls_were_replaced_is_cast_by_xla(
    plan: st.TunnelPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernels, "on_nvidia", lambda: True)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    tunnel, rows = Tunnel.from_plan(plan), (jnp.zeros((32, 2)), jnp.zeros(32), jnp.zeros(32))
    scan = jax.vmap(lambda tunnel, *row: lidar.scan(tunnel, *row, lidar.LidarParams()), (None, 0, 0, 0))
    assert "triton" in for_nvidia(scan, tunnel, *rows)
    assert "triton" not in for_nvidia(scan, dataclasses.replace(tunnel, packed=None), *rows)


def places(plan: st.TunnelPlan, lining: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (m) and stations (m): in the whole bore, about the mouths, and in corners beside vertices of walls."""
    rng = np.random.default_rng(seed)
    inside = reference.random_poses(plan, 300, rng, gap=0.1)
    mouths = reference.random_poses(plan, 150, rng, gap=0.1, near_mouths=True)
    corners = plan.lining(lining).segments[rng.integers(0, len(plan.lining(lining).segments), 300), :2]
    nearest = np.argmin(np.linalg.norm(corners[:, None] - plan.centre, axis=2), axis=1)
    inward = plan.centre[nearest] - corners
    away = rng.uniform(0.0, 0.9, (300, 1)) / np.linalg.norm(inward, axis=1, keepdims=True)
    position = np.concatenate([inside.position, mouths.position, corners + away * inward])
    station = np.concatenate([inside.station, mouths.station, plan.station[nearest]])
    return position.astype(np.float32), station.astype(np.float32)


def both(tunnel: Tunnel, position: np.ndarray, node: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    """Distances by the kernel and by XLA, m."""
    found, by_xla = _clearances(tunnel, position, node)
    return np.asarray(found), np.asarray(by_xla)


@jax.jit
def _clearances(tunnel, position, node):
    by_xla = jax.vmap(unicycle._gap, (None, 0, 0))(tunnel, position, node)
    return gpu.clearance(tunnel, position, tunnel.visit_first[node]), by_xla


def assert_equal(found: np.ndarray, truth: np.ndarray) -> None:
    """To a micrometre, exactly beyond the reach, and nowhere NaN."""
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=1e-6, equal_nan=False)
    np.testing.assert_array_equal(found == REACH, truth == REACH)


@pytest.mark.parametrize("name", NAMES)
def test_clearances_are_those_of_xla_and_of_brute_force(name: str | None) -> None:
    plan = stretch_of(name)
    tunnel, lining = Tunnel.from_plan(plan), plan.default_lining
    position, station = places(plan, lining, 1)
    found, by_xla = both(tunnel, position, nodes(tunnel, station))
    assert found.shape == station.shape
    assert_equal(found, by_xla)
    truth = reference.clearance(plan.lining(lining).segments, position)
    near = truth < 0.79
    assert near.sum() > 200
    assert (~near).sum() > 100
    np.testing.assert_allclose(found[near], truth[near], atol=1e-5)
    assert np.all(found[truth > 0.81] == REACH)


@pytest.mark.parametrize("bits", [32, 64])
@pytest.mark.parametrize("there", [False, True])
def test_a_batch_of_robots_uses_the_kernel_where_there_is_an_nvidia_gpu(
    plan: st.TunnelPlan, bits: int, there: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(kernels, "on_nvidia", lambda: there)
    one = jnp.zeros((32, 2), jnp.float32), jnp.zeros(32, jnp.float32)
    tunnel = Tunnel.from_plan(plan)
    measure = jax.vmap(unicycle.clearance, (None, 0, 0))
    if bits == 32:
        assert ("triton" in for_nvidia(measure, tunnel, *one)) is there
    else:
        with wide():
            assert ("triton" in for_nvidia(measure, tunnel, *one)) is there


def test_a_step_of_a_batch_launches_two_kernels_of_ours_and_draws_in_two_calls(monkeypatch):
    """One scan for observations before and after resets, one clearance; draws of a step: one for each kind."""
    env, params = st.make("Subterra/Faulted-v1", tunnel="control")
    state = jax.eval_shape(lambda key: st.AutoReset(env).reset(key, params, 32)[1], jax.random.key(0))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(kernels, "on_nvidia", lambda: True)
    text = for_nvidia(st.AutoReset(env).step, jax.random.key(0), state, jnp.zeros((32, 2)), params)
    assert text.count("triton") == 2
    draws = jax.make_jaxpr(lambda key: env.draw_step(key, (32,), params))(jax.random.key(0))
    assert str(draws).count("random_bits[") == 2


def test_a_range_that_is_no_number_is_wrong(plan: st.TunnelPlan) -> None:
    poses = reference.random_poses(plan, 4, np.random.default_rng(6))
    assert reference.agreement(plan.lining("pockets").segments, poses, np.full((4, 16), np.nan)).n_wrong == 64


@pytest.mark.parametrize(("backend", "kind"), [("gpu", "NVIDIA H100"), ("gpu", "AMD MI300"), ("cpu", "NVIDIA H100")])
def test_the_first_device_tells_whether_the_kernels_fit(monkeypatch, backend, kind):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(jax, "devices", lambda: [SimpleNamespace(device_kind=kind)])
    assert kernels.on_nvidia() == ((backend, kind) == ("gpu", "NVIDIA H100"))
