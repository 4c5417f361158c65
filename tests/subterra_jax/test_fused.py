"""The fused LiDAR, here in Pallas' interpreter; on a GPU `benchmarks.throughput` holds it against the reference."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax import lidar
from subterra_jax.lidar import boxes, fused, reference
from subterra_jax.tunnel import Tunnel, node_at, packed
from subterra_jax.tunnel.tunnel import stack
from tests.subterra_jax.lowering import for_nvidia


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


@pytest.mark.parametrize("n_beams", [*(pytest.param(n, marks=pytest.mark.slow) for n in (2, 12)), 16])
def test_the_kernels_give_the_ranges_of_the_reference(plan: st.TunnelPlan, n_beams: int) -> None:
    poses = reference.random_poses(plan, 70, np.random.default_rng(n_beams))
    tunnel = Tunnel.from_plan(plan)
    ranges = fused_scan(tunnel, poses, np.ones(70, bool), n_beams)
    assert ranges.shape == (70, n_beams)
    assert reference.agreement(plan.lining("pockets").segments, poses, ranges).n_wrong == 0


def test_the_kernels_lower_for_a_gpu_where_there_is_none(plan: st.TunnelPlan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    tunnel, n = Tunnel.from_plan(plan), 32
    rows = jnp.zeros((n, 2)), jnp.zeros(n), jnp.zeros(n, jnp.int32), jnp.ones(n, bool)
    limit = jnp.float32(30.0)

    def scan(tunnel, limit, *rows):
        return fused.scan(tunnel, *rows, limit, lidar.bearings(16))

    assert for_nvidia(scan, tunnel.walls, limit, *rows).count("triton") >= 2


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


def test_a_beam_along_a_row_of_deep_recesses_is_exact() -> None:
    """The kernels look into every box of the window where as many are entered as were sorted."""
    plan = st.load_tunnel("open:masonry:train:0").slice(100.0, 80.0)
    poses = reference.random_poses(plan, 64, np.random.default_rng(1))
    ranges = fused_scan(Tunnel.from_plan(plan, n_candidates=1), poses, np.ones(64, bool), 16)
    assert reference.agreement(plan.lining(plan.default_lining).segments, poses, ranges).n_wrong == 0


def test_blocks_packed_in_the_program_give_the_same_ranges(plan: st.TunnelPlan) -> None:
    poses = reference.random_poses(plan, 32, np.random.default_rng(4))
    tunnel, wanted = Tunnel.from_plan(plan), np.ones(32, bool)
    without = fused_scan(dataclasses.replace(tunnel, packed=None), poses, wanted, 16)
    np.testing.assert_array_equal(without, fused_scan(tunnel, poses, wanted, 16))


def unpacked(tunnel: Tunnel) -> list[np.ndarray]:
    return [np.asarray(part) for part in packed.unpack(tuple(jnp.asarray(tunnel.packed.box).T))]


@pytest.mark.parametrize("name", [None, "open:masonry:train:0", "open:rock:test-unseen:0"])
def test_a_packed_box_holds_the_box_of_its_block(name: str | None) -> None:
    plan = (st.load_tunnel(name) if name else st.load_tunnel()).slice(100.0, 80.0)
    tunnel = Tunnel.from_plan(plan)
    there = np.asarray(tunnel.box)[4] > 0.0
    x, y, e_x, e_y, thickness, _, _ = (part.astype(float) for part in unpacked(tunnel))
    np.testing.assert_array_equal(np.stack([x, y]), np.asarray(tunnel.box)[:2])
    assert np.all(thickness[~there] == -1.0)
    box = np.asarray(tunnel.box, np.float64)[:, there]
    e_x, e_y, thickness = e_x[there], e_y[there], thickness[there]
    length = np.hypot(e_x, e_y)
    for side in (-1.0, 1.0):
        corner_x, corner_y = box[2] - side * box[4] * box[3] / box[5], box[3] + side * box[4] * box[2] / box[5]
        assert np.all(np.abs(corner_y * e_x - corner_x * e_y) <= thickness * length)
        assert np.all(np.abs(corner_x * e_x + corner_y * e_y) <= (length + thickness) * length)
    grown = thickness - box[4]
    assert 0.0 < grown.max() < 0.01


def test_a_packed_box_has_the_vertices_of_its_block_and_the_window_that_begins_there(plan: st.TunnelPlan) -> None:
    tunnel = Tunnel.from_plan(plan)
    *_, pairs, window = unpacked(tunnel)
    wall = np.asarray(tunnel.wall)
    moves = np.any(wall[:, :, 1:] != wall[:, :, :-1], axis=1)
    assert not any(moves[i, 2 * n - 1 :].any() for i, n in enumerate(pairs))
    assert np.mean(2 * pairs < wall.shape[2]) > 0.1
    first = np.unique(np.asarray(tunnel.scan_first))
    assert np.all((window[first] >= 1) & (window[first] <= tunnel.n_scan))
    assert window[np.setdiff1d(np.arange(len(window)), first)].max() == 0
    number, start = np.asarray(tunnel.packed.wall), np.asarray(tunnel.packed.start)
    assert len(number) == pairs.sum()
    for i in (0, len(wall) // 2, len(wall) - 1):
        own = number[start[i] : start[i] + int(pairs[i])].reshape(-1, 2)[: wall.shape[2]]
        np.testing.assert_array_equal(own, wall[i].T[: len(own)])


def test_a_stack_is_packed_as_its_tunnels_are(plan: st.TunnelPlan) -> None:
    one, other = Tunnel.from_plan(plan), Tunnel.from_plan(st.load_tunnel("open:masonry:train:0").slice(100.0, 80.0))
    both = stack([one, other])
    for tunnel, begin in ((one, 0), (other, int(both.scan_first[-1] - other.scan_first[-1]))):
        own = slice(begin, begin + len(tunnel.packed.box))
        np.testing.assert_array_equal(both.packed.box[own], tunnel.packed.box)
        shift = int(both.packed.start[begin])
        np.testing.assert_array_equal(both.packed.start[own] - shift, tunnel.packed.start)
        np.testing.assert_array_equal(both.packed.wall[shift : shift + len(tunnel.packed.wall)], tunnel.packed.wall)


def test_counts_that_do_not_fit_stand_for_everything(plan: st.TunnelPlan) -> None:
    """Blocks of more than 62 vertices."""
    poses = reference.random_poses(plan, 32, np.random.default_rng(5))
    tunnel = Tunnel.from_plan(plan, block_length=20.0, max_segments=90)
    assert unpacked(tunnel)[5].max() == packed.ALL_PAIRS
    ranges = fused_scan(tunnel, poses, np.ones(32, bool), 16)
    assert reference.agreement(plan.lining("pockets").segments, poses, ranges).n_wrong == 0


def test_nothing_behind_the_last_box_that_a_thread_kept_is_taken_for_known() -> None:
    """A thread that gave the first two boxes of a beam may have had the third, and kept two."""
    rng = np.random.default_rng(0)
    keys = np.stack([rng.permutation(64) for _ in range(200)]).reshape(200, 8, 8)  # scans, threads, boxes
    kept = tuple(jnp.asarray(np.sort(keys, axis=2)[:, :, i]) for i in range(2))
    found = np.concatenate([np.asarray(one) for one in boxes._first_of_all(kept, 3)], axis=1)
    truth = np.sort(keys.reshape(200, 64), axis=1)[:, :3]
    of_one_thread = np.array([len({*np.where(scan < 2)[0]}) == 1 for scan in keys])
    assert of_one_thread.sum() > 10
    np.testing.assert_array_equal(found[:, :2], truth[:, :2])
    np.testing.assert_array_equal(found[:, 2], np.where(of_one_thread, truth[:, 1], truth[:, 2]))


def test_a_range_that_is_no_number_is_wrong(plan: st.TunnelPlan) -> None:
    poses = reference.random_poses(plan, 4, np.random.default_rng(6))
    assert reference.agreement(plan.lining("pockets").segments, poses, np.full((4, 16), np.nan)).n_wrong == 64
