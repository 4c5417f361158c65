"""The fused distance to the walls, here in Pallas' interpreter, against XLA's and against float64 brute force."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import subterra_jax as st
from subterra_jax.lidar import nvidia, reference
from subterra_jax.parts import fused_gap, unicycle
from subterra_jax.tunnel import CONTACT_REACH, Tunnel, node_at, packed
from subterra_jax.tunnel.tunnel import stack
from tests.subterra_jax.lowering import for_nvidia
from tests.subterra_jax.modes import wide

KINDS = ("straight:train", "cast:train", "sprayed:train", "masonry:train", "universal:test-unseen", "rock:test-unseen")
NAMES = [None, *(f"open:{kind}:0" for kind in KINDS)]
REACH = np.float32(CONTACT_REACH)


def piece_of(name: str | None) -> st.TunnelPlan:
    return (st.load_tunnel(name) if name else st.load_tunnel()).slice(100.0, 60.0)


@pytest.fixture(scope="module")
def plan() -> st.TunnelPlan:
    return piece_of(None)


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


def windows(tunnel: Tunnel, station: np.ndarray) -> jax.Array:
    return tunnel.contact_first[jax.vmap(node_at, (None, 0))(tunnel, jnp.asarray(station))]


def boxes(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Boxes as in `Tunnel`, up to 3 m long and 20 cm thick, turned anyhow, and walls along their axes."""
    half = rng.uniform(0.1, 1.5, n) * np.exp(1j * rng.uniform(-np.pi, np.pi, n))
    box = np.stack([*rng.uniform(-50.0, 50.0, (2, n)), half.real, half.imag, rng.uniform(0.0, 0.1, n), np.abs(half)])
    wall = np.stack([[-half.real, half.real], [-half.imag, half.imag]]).transpose(2, 0, 1)
    return box.astype(np.float32), wall.astype(np.float32)


def both(tunnel: Tunnel, position: np.ndarray, first: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    """Distances by the kernel and by XLA, m."""
    by_xla = jax.vmap(unicycle._gap, (None, 0, 0))(tunnel, jnp.asarray(position), first)
    return np.asarray(fused_gap.clearance(tunnel, jnp.asarray(position), first)), np.asarray(by_xla)


def assert_equal(found: np.ndarray, truth: np.ndarray) -> None:
    """To a micrometre, exactly beyond the reach, and nowhere NaN."""
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=1e-6, equal_nan=False)
    np.testing.assert_array_equal(found == REACH, truth == REACH)


@pytest.mark.parametrize("name", NAMES)
def test_the_kernel_finds_what_xla_finds_and_brute_force(name: str | None) -> None:
    plan = piece_of(name)
    tunnel, lining = Tunnel.from_plan(plan), plan.default_lining
    position, station = places(plan, lining, 1)
    found, by_xla = both(tunnel, position, windows(tunnel, station))
    assert found.shape == station.shape
    assert_equal(found, by_xla)
    truth = reference.clearance(plan.lining(lining).segments, position)
    near = truth < 0.79
    assert near.sum() > 200
    assert (~near).sum() > 100
    np.testing.assert_allclose(found[near], truth[near], atol=1e-5)
    assert np.all(found[truth > 0.81] == REACH)


def test_the_walls_of_no_box_far_away_are_looked_at() -> None:
    """A box counts as near up to the reach, and at its corners up to √2 of it."""
    rng = np.random.default_rng(5)
    words = packed.pack(*boxes(rng, 4000), None, np.zeros(4000)).box
    x, y, e_x, e_y, thickness, _, _ = (np.asarray(part, float) for part in packed.unpack(tuple(words.T)))
    at = np.stack([x, y]) + rng.uniform(-4.0, 4.0, (2, 4000))
    length = np.hypot(e_x, e_y)
    along = np.abs((at[0] - x) * e_x + (at[1] - y) * e_y) / length - length
    across = np.abs((at[0] - x) * e_y - (at[1] - y) * e_x) / length - thickness
    gap = np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0))
    near = np.asarray(fused_gap._is_near(tuple(jnp.asarray(words).T), *jnp.asarray(at, jnp.float32)))
    assert near[gap <= REACH].all()
    assert not near[gap > 1.42 * REACH + 1.5 * thickness].any()
    assert np.mean(near[gap > REACH]) < 0.1


def test_each_tunnel_of_a_stack_has_its_own_distances(plan: st.TunnelPlan) -> None:
    """And more boxes in a window than a point has threads."""
    plans = [plan, piece_of(NAMES[4]), piece_of(NAMES[2])]
    tunnels = [Tunnel.from_plan(each, block_length=0.4) for each in plans]
    joined = stack(tunnels)
    assert joined.n_contact > 2 * fused_gap.LANES
    for i, (each, tunnel) in enumerate(zip(plans, tunnels, strict=True)):
        position, station = places(each, each.default_lining, i)
        found, by_xla = both(joined.walls, position, windows(joined.pick(i), station))
        assert_equal(found, by_xla)
        assert_equal(found, both(tunnel, position, windows(tunnel, station))[0])


def test_furniture_counts(plan: st.TunnelPlan) -> None:
    tunnel = Tunnel.from_plan(plan, "furnished")
    position, station = places(plan, "furnished", 2)
    found, by_xla = both(tunnel, position, windows(tunnel, station))
    assert_equal(found, by_xla)
    assert np.any(found < both(Tunnel.from_plan(plan), position, windows(Tunnel.from_plan(plan), station))[0] - 0.1)


@pytest.mark.parametrize("n", [1, 33])
def test_any_number_of_points(plan: st.TunnelPlan, n: int) -> None:
    tunnel = Tunnel.from_plan(plan)
    position, station = (part[-n:] for part in places(plan, plan.default_lining, 3))
    found, by_xla = both(tunnel, position, windows(tunnel, station))
    assert_equal(found, by_xla)


def test_blocks_of_any_size_packed_on_the_host_or_in_the_program(plan: st.TunnelPlan) -> None:
    """Blocks of more vertices than their counts can say, and more than two rounds of the threads."""
    tunnel = Tunnel.from_plan(plan, block_length=20.0, max_segments=90)
    position, station = places(plan, plan.default_lining, 4)
    for each in (tunnel, dataclasses.replace(tunnel, packed=None)):
        found, by_xla = both(each, position, windows(each, station))
        assert_equal(found, by_xla)


@pytest.mark.parametrize("bits", [32, 64])
@pytest.mark.parametrize("there", [False, True])
def test_a_batch_of_robots_uses_the_kernel_where_there_is_an_nvidia_gpu(
    plan: st.TunnelPlan, bits: int, there: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(nvidia, "present", lambda: there)
    one = jnp.zeros((32, 2), jnp.float32), jnp.zeros(32, jnp.float32)
    tunnel = Tunnel.from_plan(plan)
    measure = jax.vmap(unicycle.clearance, (None, 0, 0))
    if bits == 32:
        assert ("triton" in for_nvidia(measure, tunnel, *one)) is there
    else:
        with wide():
            assert ("triton" in for_nvidia(measure, tunnel, *one)) is there
