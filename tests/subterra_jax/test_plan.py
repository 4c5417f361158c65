"""Tunnel files: what is wrong with a broken one is said with its file and its field."""

import dataclasses
import hashlib
import json
import re
import zlib
from contextlib import nullcontext
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

import subterra_jax as st
from benchmarks import reference
from subterra_jax.host.tunnelfile import read_fields
from subterra_jax.tunnel.sources import PACKAGED, tunnel_digest
from tests.recorded import check
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
        ("tangent", lambda a: a * np.where(np.arange(len(a)) == 7, 1.0011, 1.0)[:, None]),
        ("tangent", lambda a: a * np.where(np.arange(len(a)) == 9, -1.0, 1.0)[:, None]),
        ("elevation", lambda a: None),
        ("half_width", lambda a: -a),
        ("lidar_height", lambda a: np.zeros(2)),
        ("ring_pitch", lambda a: np.array(-1.5)),
        ("ring_pitch", lambda a: np.zeros(2)),
        ("lining", lambda a: np.zeros(2)),
        ("left_smooth", lambda a: None),
        ("left_smooth", lambda a: a[:1]),
        ("right_pockets", lambda a: a[:, :1]),
        ("right_smooth", lambda a: np.add(a, [0.0, 6.0])),
        ("right_station_smooth", lambda a: a[[1, 0, *range(2, len(a))]]),
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
    assert plan_of(tunnels.tunnel_arrays(tunnels.straight(10.0), centre_step=10.0)).length == 10.0  # two stations do
    assert st.load_tunnel("subterra-351").ring_pitch == pytest.approx(1.5, abs=1e-3)


def test_a_digest_tells_tunnels_apart_and_is_that_of_the_file_where_there_is_one(tmp_path, arrays):
    path = tunnels.write_tunnel(tmp_path / "t.npz", arrays)
    assert tunnel_digest(path) == hashlib.sha256(path.read_bytes()).hexdigest()
    names = ("control", "open:val:1", "open:val:2", None)
    assert len({tunnel_digest(name) for name in names}) == 4
    assert tunnel_digest("open:val:1") == tunnel_digest("open:val:1")


def test_the_packaged_pockets_cross_the_plane_of_the_lidar_on_both_walls():
    plan = st.load_tunnel()
    for side in ("left", "right"):
        wall = getattr(plan.lining("pockets"), side)
        centre = np.stack([np.interp(wall.station, plan.station, plan.centre[:, i]) for i in (0, 1)], axis=1)
        away = np.hypot(*(wall.vertex - centre).T) - np.interp(wall.station, plan.station, plan.half_width)
        recessed = away > 0.6 * 0.13
        rings = np.unique(np.round(wall.station[recessed] / plan.ring_pitch))
        assert len(rings) > 0.8 * plan.length / plan.ring_pitch


DATA = resources.files("subterra_jax") / "data"
TABLE = Path(__file__).with_name("values.csv")


def manifest(name: str) -> dict:
    return json.loads((DATA / f"{name}.json").read_text())


def test_subterra_351_has_the_586_sleepers_of_the_paper_all_of_them_whole_between_its_mouths():
    shell = st.load_tunnel("subterra-351").shell
    sleeper = shell.track[shell.track[:, 12] > 0.0]  # alone they taper
    assert len(sleeper) == manifest("subterra-351")["count"]["sleepers"] == 586
    station = np.sort(np.argmin(np.linalg.norm(shell.position[None] - sleeper[:, None, :3], axis=2), axis=1))
    along = shell.station[station]
    assert np.median(np.diff(along)) == pytest.approx(0.6, abs=0.15)  # to a station
    assert np.mean(np.diff(np.sort(along))) == pytest.approx(0.599, abs=0.002)
    assert along.min() > 0.1
    assert along.max() < shell.station[-1] - 0.1


@pytest.mark.parametrize("name", PACKAGED)
def test_a_packaged_tunnel_is_one_small_file_with_plane_and_heights_and_says_what_built_it_and_when(name):
    plan, facts = st.load_tunnel(name), manifest(name)
    assert (plan.name, plan.provenance) == (facts["name"], facts["input_provenance"])
    assert plan.length == pytest.approx(facts["bore"]["length"], abs=1e-5)
    assert set(plan.shell.linings) == set(plan.linings) == {"smooth", "pockets", "furnished"}
    assert re.fullmatch(r"\d+\.\d+\.\d+", facts["builder"])  # an older one: no release builds them anew
    assert facts["config"]["date"] >= "2026-11-26"
    assert (DATA / f"{name}.npz").stat().st_size < 800_000
    check(TABLE, name, dataclasses.replace(plan, source=""))


def test_what_is_shipped_packs_into_a_wheel_of_10_mb():
    root = resources.files("subterra_jax")
    with resources.as_file(root) as folder:
        files = [file for file in Path(folder).rglob("*") if file.is_file() and "__pycache__" not in file.parts]
        packed = {file.name: len(zlib.compress(file.read_bytes(), 6)) for file in files}
    assert sum(packed.values()) < 9_900_000, f"the largest is {max(packed, key=packed.__getitem__)}"


@pytest.mark.parametrize(
    ("field", "corrupt", "refused"),
    [
        ("shell_rise", lambda a: np.where(np.arange(len(a)) == 7, 0.9, a), None),
        ("shell_rise", lambda a: np.where(np.arange(len(a)) == 7, 1.0, a), "above -1 and below 1"),
        ("shell_rise", lambda a: np.where(np.arange(len(a)) == 7, -1.0, a), "above -1 and below 1"),
        ("shell_angle", lambda a: a + 0.5e-6 * (np.arange(len(a)) == 3), None),
        ("shell_angle", lambda a: a + 2e-6 * (np.arange(len(a)) == 3), "at least 8 even directions"),
        ("shell_angle", lambda a: 2.0 * np.pi / 7.0 * np.arange(7), "at least 8 even directions"),
        ("shell_section", lambda a: a * (np.arange(len(a)) != 3), "must give positive distances"),
        ("shell_spacing", lambda a: np.array([0.1, 0.12]), None),
        ("shell_spacing", lambda a: np.array([0.1, 0.0]), "must be positive"),
    ],
)
def test_a_bore_in_three_dimensions_is_read_and_refused_by_its_field(tmp_path, field, corrupt, refused):
    packaged = Path(st.__file__).parent / "data" / "subterra-351.npz"
    arrays = {name: value for name, value in read_fields(packaged).items() if name not in ("unit", "shell_unit")}
    np.savez(tmp_path / "bore.npz", **{**arrays, field: corrupt(arrays.get(field))})
    with pytest.raises(st.TunnelError, match=rf"bore\.npz.*{field}.*{refused}") if refused else nullcontext():
        shell = st.load_tunnel(tmp_path / "bore.npz").shell
        np.testing.assert_allclose(np.linalg.norm(shell.tangent, axis=1), 1.0, atol=1e-9)
        assert shell.spacing == ((0.1, 0.12) if field == "shell_spacing" else (0.18, 0.2))
