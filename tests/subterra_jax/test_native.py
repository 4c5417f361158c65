"""The CPU's kernels against XLA, which is compared with the truth elsewhere."""

import os
import subprocess
import sys
import threading
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import reference
from subterra_jax import lidar, load_tunnel, native
from subterra_jax.parts import unicycle as vehicle
from subterra_jax.rows import rowwise
from subterra_jax.tunnel import Tunnel
from tests.subterra_jax import tunnels

pytestmark = pytest.mark.skipif(not native.supported(), reason="numba is not installed, or this is not a CPU")

by_kernel = partial(lidar.LidarParams)
by_xla = partial(lidar.LidarParams, fused=False)


@partial(jax.jit, static_argnames=("make", "n_beams"))
def scans(tunnel, poses, make, n_beams=16):
    one = partial(lidar.scan, params=make(n_beams=n_beams))
    return jax.vmap(one, (None, 0, 0, 0))(tunnel, *poses)


@pytest.fixture(scope="module")
def plan():
    return load_tunnel("subterra-351")


def poses_in(plan, n, seed=5, **kwargs):
    poses = reference.random_poses(plan, n, np.random.default_rng(seed), **kwargs)
    return tuple(jnp.asarray(part) for part in (poses.position, poses.heading, poses.station))


def check_same(plan, lining, n_beams=16, **kwargs):
    """All but beams that pass an edge within float32 rounding, where one may see past it and the other not."""
    tunnel, poses = Tunnel.from_plan(plan, lining), poses_in(plan, 700, **kwargs)
    error = np.abs(scans(tunnel, poses, by_kernel, n_beams) - scans(tunnel, poses, by_xla, n_beams))
    assert np.mean(error > 1e-3) <= 1e-3
    assert np.median(error) < 1e-5


@pytest.mark.parametrize("lining", ["smooth", "pockets", "furnished"])
def test_scans_are_those_of_xla(plan, lining):
    check_same(plan, lining)


def test_blocks_of_many_segments_and_windows_of_few_blocks_are_those_of_xla(plan_of, monkeypatch):
    plan = plan_of(tunnels.tunnel_arrays(tunnels.straight(12.0), roughness=0.015, correlation=0.1))
    monkeypatch.setattr("subterra_jax.tunnel.tunnel.BLOCK_LENGTH", 8.0)
    monkeypatch.setattr("subterra_jax.tunnel.tunnel.MOST_SEGMENTS", 50)
    tunnel, poses = Tunnel.from_plan(plan, "smooth"), poses_in(plan, 300)
    assert tunnel.wall.shape[2] > 17
    assert tunnel.n_scan < 16
    np.testing.assert_allclose(scans(tunnel, poses, by_kernel), scans(tunnel, poses, by_xla), atol=1e-4)


def test_clearances_are_exact_within_their_reach(plan):
    for lining in ("pockets", "furnished"):
        tunnel, (position, _, station) = Tunnel.from_plan(plan, lining), poses_in(plan, 500, gap=0.05)
        found = jax.jit(jax.vmap(vehicle.clearance, (None, 0, 0)))(tunnel, position, station)
        truth = np.minimum(reference.clearance(plan.lining(lining).segments, np.asarray(position, np.float64)), 0.8)
        assert np.mean(truth < 0.8) > 0.1
        np.testing.assert_allclose(found, truth, atol=2e-5)


def test_a_scan_that_nobody_wants_leaves_its_neighbours_alone(plan):
    tunnel, poses = Tunnel.from_plan(plan, "pockets"), poses_in(plan, 100)
    one = lambda *row: lidar.scan(tunnel, *row[:3], by_kernel(), row[3])  # noqa: E731
    expected = jnp.arange(100) % 3 == 0
    some = np.asarray(jax.jit(jax.vmap(one))(*poses, expected))
    np.testing.assert_array_equal(some[::3], scans(tunnel, poses, by_kernel)[::3])


def on_three_threads(monkeypatch):
    """Return `scans` by kernels on three threads, whatever this machine has."""
    monkeypatch.setattr("subterra_jax.native.calls.cores", lambda: 3)
    return jax.jit(jax.vmap(partial(lidar.scan, params=by_kernel()), (None, 0, 0, 0)))


def test_however_rows_are_batched_and_shared_out_they_are_the_same_bits(plan, monkeypatch):
    tunnel, poses = Tunnel.from_plan(plan, "pockets"), poses_in(plan, 601)
    np.testing.assert_array_equal(on_three_threads(monkeypatch)(tunnel, *poses), scans(tunnel, poses, by_kernel))
    poses = tuple(part[:600] for part in poses)
    whole = np.asarray(scans(tunnel, poses, by_kernel))
    pieces = [scans(tunnel, tuple(part[i : i + 20] for part in poses), by_kernel) for i in range(0, 600, 20)]
    np.testing.assert_array_equal(whole, np.concatenate(pieces))
    folded = tuple(part.reshape(6, 100, *part.shape[1:]) for part in poses)
    one = partial(lidar.scan, params=by_kernel())
    nested = jax.jit(jax.vmap(jax.vmap(one, (None, 0, 0, 0)), (None, 0, 0, 0)))(tunnel, *folded)
    np.testing.assert_array_equal(whole, np.asarray(nested).reshape(whole.shape))


def test_programs_that_run_at_the_same_time_do_not_lock_each_other(plan, monkeypatch):
    tunnel, poses = Tunnel.from_plan(plan, "pockets"), poses_in(plan, 600)
    scans = on_three_threads(monkeypatch)
    whole, wrong = np.asarray(scans(tunnel, *poses)), []

    def scan_often():
        wrong.extend(i for i in range(40) if not np.array_equal(scans(tunnel, *poses), whole))

    threads = [threading.Thread(target=scan_often, daemon=True) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert not any(thread.is_alive() for thread in threads)
    assert wrong == []


def test_tunnels_of_their_own_for_each_row_go_to_xla():
    single = lambda shared, x: shared * x  # noqa: E731
    function = rowwise(single, lambda shared, x: jnp.full_like(x, -1.0))
    x = jnp.arange(6.0)
    np.testing.assert_array_equal(jax.vmap(function, (None, 0))(2.0, x), -jnp.ones(6))
    np.testing.assert_array_equal(jax.vmap(function)(x, x), x * x)
    inner = jax.vmap(function, (None, 0))
    np.testing.assert_array_equal(jax.vmap(inner)(x[:2], x.reshape(2, 3)), x[:2, None] * x.reshape(2, 3))


def test_the_compiled_step_calls_the_kernels(plan):
    tunnel, poses = Tunnel.from_plan(plan, "pockets"), poses_in(plan, 10)
    assert "subterra_scan" in scans.lower(tunnel, poses, by_kernel).as_text()
    assert "subterra_scan" not in scans.lower(tunnel, poses, by_xla).as_text()


@pytest.mark.slow
def test_kernels_that_two_processes_compiled_run_in_a_third(tmp_path):
    scan = """
import jax
import subterra_jax as st
env, params = st.make("Subterra/TraverseShort-v1")
print(float(st.AutoReset(env).reset(jax.random.key(0), params, 512)[0].sum()))
"""
    march = """
import jax.numpy as jnp
import subterra_jax as st
from subterra_jax import lidar3d
plan = st.load_tunnel("open:straight:val:4").slice(20.0, 60.0)
relief = lidar3d.Relief.from_plan(plan)
at = jnp.append(jnp.asarray(plan.centre[40]), plan.elevation[40] + 0.7)
at, beams = (jnp.tile(each, (4096, 1)) for each in (at, jnp.array([0.0, 1.0, 0.0])))
print(float(lidar3d.meet(relief, at, beams, plan.station[40], 30.0).ranges.sum()))
"""
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    for code in (scan, march, scan + march, scan + march):
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=280
        )
        assert done.returncode == 0, done.stderr[-2000:]
