"""Voxels list every triangle that comes near them, and files that are missing or spoiled are named."""

import numpy as np
import pytest

from subterra_jax.host.errors import TunnelError
from subterra_jax.lidar3d import relief, surface
from subterra_jax.lidar3d.relief import Relief
from tests.subterra_jax import surfaces


@pytest.fixture(scope="module")
def sorted_bend():
    axis = surfaces.axis_of(30.0, 1 / 60.0)
    vertices, faces = surfaces.tube(axis, 2.0, 24, 31)
    blocks = relief.cut_blocks(axis["station"], axis["position"], axis["tangent"], 8.0)
    filled = relief.fill_voxels(blocks, axis["station"], axis["position"], vertices, faces, (0.4, 0.3, 0.3))
    return blocks, filled, vertices[faces]


def test_every_point_of_every_triangle_lies_in_a_voxel_that_lists_a_triangle_through_it(sorted_bend):
    blocks, filled, corner = sorted_bend
    share = np.random.default_rng(0).dirichlet(np.ones(3), len(corner))
    points = np.einsum("tk,tki->ti", share, corner)
    found = np.zeros(len(points), bool)
    for k, (centre, turn) in enumerate(zip(blocks.centre, blocks.turn, strict=True)):
        local = (points - centre) @ turn.T
        inside = (local @ blocks.front[k, :3] <= blocks.front[k, 3]) & (local @ blocks.back[k, :3] >= blocks.back[k, 3])
        shape = np.array(filled.code.shape[1:])
        for p in np.flatnonzero(inside):
            place = np.clip(np.floor((local[p] - filled.low) / filled.cell), 0, shape - 1).astype(int)
            code = filled.code[(k, *place)]
            assert code >= 0
            rows = filled.triangle[filled.member[filled.first[code] : filled.first[code + 1]]]
            normal = np.cross(rows[:, 3:6], rows[:, 6:9])
            gap = np.einsum("ij,ij->i", local[p] - rows[:, :3], normal) / np.linalg.norm(normal, axis=1)
            assert np.abs(gap).min() < 1e-9
            found[p] = True
    assert found.all()


def test_an_empty_voxel_knows_how_far_the_nearest_list_is(sorted_bend):
    code = sorted_bend[1].code
    rng = np.random.default_rng(1)
    for k, *at in rng.integers(0, code.shape, (300, 4)):
        if code[(k, *at)] < 0:
            away = np.max(np.abs(np.argwhere(code[k] >= 0) - at), axis=1).min()
            assert -code[(k, *at)] == away


def test_planes_of_neighbouring_blocks_are_the_same(sorted_bend):
    blocks = sorted_bend[0]
    for k in range(len(blocks.centre) - 1):
        normal = blocks.turn[k].T @ blocks.front[k, :3]
        np.testing.assert_allclose(blocks.turn[k + 1].T @ blocks.back[k + 1, :3], normal, atol=1e-6)
        point = blocks.centre[k] + normal * blocks.front[k, 3]
        assert (point - blocks.centre[k + 1]) @ normal == pytest.approx(blocks.back[k + 1, 3], abs=1e-6)


def test_a_surface_away_from_the_axis_is_refused():
    axis = surfaces.axis_of(30.0)
    far = surfaces.box((500.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="no triangle lies along the axis"):
        Relief.from_triangles(surface.Axis(**axis), surface.Triangles(*far))


def test_what_is_missing_or_spoiled_in_a_scene_folder_is_named(tmp_path):
    with pytest.raises(TunnelError, match=r"bore\.npz"):
        Relief.from_scene(tmp_path)
    (tmp_path / "bore.npz").write_bytes(b"no archive")
    with pytest.raises(TunnelError, match=r"bore\.npz: not a bore file"):
        surface.read_axis(tmp_path / "bore.npz")
    np.savez(tmp_path / "bore.npz", schema="subterra.bore/0")
    with pytest.raises(TunnelError, match=r"older Subterra \(schema subterra\.bore/0"):
        surface.read_axis(tmp_path / "bore.npz")
    np.savez(tmp_path / "bore.npz", schema="subterra.bore/1", **surfaces.axis_of(10.0))
    with pytest.raises(TunnelError, match=r"scene\.xml: no such scene"):
        Relief.from_scene(tmp_path)
    (tmp_path / "scene.xml").write_text("<mujoco><worldbody/></mujoco")
    with pytest.raises(TunnelError, match=r"scene\.xml: MuJoCo refuses the scene"):
        Relief.from_scene(tmp_path)
    with pytest.raises(TunnelError, match="there is no lining 'brick'"):
        Relief.from_scene(tmp_path, "brick")
    (tmp_path / "scene.xml").write_text("<mujoco><worldbody/></mujoco>")
    with pytest.raises(TunnelError, match=r"lining_smooth\.ply: no such mesh"):
        Relief.from_scene(tmp_path, "smooth")
