"""Tunnel files: what is wrong with a broken one is said with its file and its field."""

import hashlib
import itertools

import numpy as np
import pytest

import subterra_jax as st
from benchmarks import reference
from subterra_jax.tunnel.sources import tunnel_digest
from tests.subterra_jax import tunnels


@pytest.fixture
def arrays():
    made = tunnels.tunnel_arrays(tunnels.s_bend(100.0, 100.0, lead=10.0), roughness=0.01)
    return {**made, "ring_pitch": np.array(1.5)}


@pytest.mark.parametrize(
    ("field", "corrupt"),
    [
        ("name", lambda a: None),
        ("provenance", lambda a: 3.0),
        ("station", lambda a: a + 1.0),
        ("station", lambda a: a**1.01),
        ("centre", lambda a: a[:-1]),
        ("centre", lambda a: np.where(np.arange(len(a))[:, None] == 7, np.nan, a)),
        ("tangent", lambda a: 2.0 * a),
        ("elevation", lambda a: None),
        ("half_width", lambda a: -a),
        ("lidar_height", lambda a: np.zeros(2)),
        ("ring_pitch", lambda a: np.array(-1.5)),
        ("ring_pitch", lambda a: np.zeros(2)),
        ("lining", lambda a: np.zeros(2)),
        ("left_smooth", lambda a: None),
        ("left_smooth", lambda a: a[:1]),
        ("right_pockets", lambda a: a[:, :1]),
        ("right_station_smooth", lambda a: a[::-1]),
        ("left_station_pockets", lambda a: a[1:]),
        ("furniture_pockets", lambda a: np.zeros((3, 3))),
        ("left_pockets", lambda a: a.astype(str)),
    ],
)
def test_a_broken_field_is_named_together_with_its_file(tmp_path, arrays, field, corrupt):
    corrupted = corrupt(arrays[field])
    arrays.pop(field)
    if corrupted is not None:
        arrays[field] = corrupted
    path = tunnels.write_tunnel(tmp_path / "broken.npz", arrays)
    with pytest.raises(st.TunnelError, match=rf"broken\.npz.*'{field}'"):
        st.load_tunnel(path)


def test_a_file_that_is_no_archive_or_not_there_is_named(tmp_path):
    (tmp_path / "text.npz").write_text("not an archive")
    for name in ("text.npz", "absent.npz"):
        with pytest.raises(st.TunnelError, match=name):
            st.load_tunnel(tmp_path / name)


@pytest.mark.parametrize("lining", ["smooth", "pockets"])
def test_a_slice_keeps_the_walls_and_opens_its_ends(plan_of, arrays, lining):
    whole = plan_of(arrays)
    piece = whole.slice(20.1, 45.3)
    assert piece.length == pytest.approx(45.3)
    assert piece.station[0] == 0.0
    poses = reference.random_poses(piece, 300, np.random.default_rng(0))
    inside = reference.scan(piece.lining(lining).segments, poses.position, poses.heading)
    before = reference.scan(whole.lining(lining).segments, poses.position, poses.heading)
    # Where the piece has a wall it is the old one; through its mouths a beam sees nothing.
    np.testing.assert_allclose(inside[inside < 30.0], before[inside < 30.0], atol=1e-9)
    assert ((inside == 30.0) & (before < 30.0)).any()


@pytest.mark.parametrize(("start", "length"), [(-1.0, 10.0), (95.0, 10.0), (10.0, 0.0)])
def test_a_slice_beyond_the_tunnel_is_refused(plan_of, arrays, start, length):
    with pytest.raises(ValueError, match="does not lie within"):
        plan_of(arrays).slice(start, length)


def test_the_ring_pitch_is_read_and_is_0_in_a_file_without_it(plan_of, arrays):
    assert plan_of(arrays).ring_pitch == 1.5
    assert float(st.Tunnel.from_plan(plan_of(arrays)).ring_pitch) == 1.5
    assert plan_of(arrays).slice(10.0, 20.0).ring_pitch == 1.5
    arrays.pop("ring_pitch")
    assert plan_of(arrays).ring_pitch == 0.0
    assert st.load_tunnel("subterra-351").ring_pitch == pytest.approx(1.5, abs=1e-3)


def test_a_digest_tells_tunnels_apart_and_is_that_of_the_file_where_there_is_one(tmp_path, arrays):
    path = tunnels.write_tunnel(tmp_path / "t.npz", arrays)
    assert tunnel_digest(path) == hashlib.sha256(path.read_bytes()).hexdigest()
    names = ("control", "open:val:1", "open:val:2", None)
    assert len({tunnel_digest(name) for name in names}) == 4
    assert tunnel_digest("open:val:1") == tunnel_digest("open:val:1")


def test_the_packaged_pockets_cross_the_plane_of_the_lidar_on_both_walls():
    plan = st.load_tunnel()
    depth = 0.13
    for side in ("left", "right"):
        wall = getattr(plan.lining("pockets"), side)
        centre = np.stack([np.interp(wall.station, plan.station, plan.centre[:, i]) for i in (0, 1)], axis=1)
        away = np.hypot(*(wall.vertex - centre).T) - np.interp(wall.station, plan.station, plan.half_width)
        recessed = away > 0.6 * depth
        rings = np.unique(np.round(wall.station[recessed] / plan.ring_pitch))
        assert len(rings) > 0.8 * plan.length / plan.ring_pitch


def test_universal_rings_stand_in_the_plane_of_the_lidar_only_now_and_then():
    plan = st.load_tunnel("metro")
    assert plan.ring_pitch == 1.4
    pocket = plan.shell.linings["pockets"].pocket
    rings = np.unique(pocket[:, 0])
    np.testing.assert_allclose(np.median(np.diff(rings)), 1.4, atol=1e-3)
    assert not len(plan.shell.linings["smooth"].pocket)
    angle = [set(np.round(pocket[pocket[:, 0] == ring, 1], 6)) for ring in rings]
    assert not any(a & b for a, b in itertools.pairwise(angle))
    wall = plan.lining("pockets").left
    centre = np.stack([np.interp(wall.station, plan.station, plan.centre[:, i]) for i in (0, 1)], axis=1)
    away = np.hypot(*(wall.vertex - centre).T) - np.interp(wall.station, plan.station, plan.half_width)
    met = np.unique(np.round(wall.station[away > 0.06] / plan.ring_pitch))
    assert 0.2 < len(met) / len(rings) < 0.6
    assert len(np.unique(np.diff(met))) > 4  # at no even distance
