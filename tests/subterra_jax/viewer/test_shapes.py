"""A scene folder as the viewer shows it."""

import numpy as np
import pytest
import trimesh

from subterra_jax.host.errors import TunnelError
from subterra_jax.viewer.geometry import lining_shape, scene_shapes

_SCENE = """<mujoco>
  <compiler meshdir="meshes"/>
  <asset>
    <material name="sleeper" rgba="0.2 0.4 0.6 1"/>
    <material name="concrete" rgba="1 1 1 1"/>
    <mesh name="lining" file="lining.obj" inertia="shell"/>
  </asset>
  <worldbody>
    <geom name="lining_000" type="mesh" mesh="lining" material="concrete" group="0"/>
    <geom name="sleeper_0" type="box" pos="1 0 0" size="0.1 1.2 0.1" material="sleeper" group="1"/>
    <geom name="sleeper_1" type="box" pos="3 0 0" size="0.1 1.2 0.1" material="sleeper" group="1"/>
    <geom name="wall_0" type="box" pos="0 3 1" size="4 0.1 1" group="3"/>
    <geom name="scout_hull" type="box" pos="2 0 1" size="0.3 0.3 0.3" group="2"/>
  </worldbody>
</mujoco>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    (folder / "meshes").mkdir()
    tube = trimesh.creation.cylinder(2.5, 10.0)
    for name in ("lining.obj", "lining.ply", "lining_smooth.ply"):
        tube.export(folder / "meshes" / name)
    (folder / "scene.xml").write_text(_SCENE)
    return folder


def test_what_a_camera_sees_is_one_shape_for_each_material(folder):
    lining, sleepers = sorted(scene_shapes(folder, "pockets"), key=lambda shape: shape.group)
    assert (lining.group, sleepers.group) == ("lining", "track")
    assert sleepers.colour == (51, 102, 153)
    assert len(sleepers.faces) == 24
    np.testing.assert_allclose(sleepers.vertices.min(axis=0), [0.9, -1.2, -0.1], atol=1e-6)
    np.testing.assert_allclose(sleepers.vertices.max(axis=0), [3.1, 1.2, 0.1], atol=1e-6)
    np.testing.assert_allclose(np.ptp(lining.vertices, axis=0), [5.0, 5.0, 10.0], atol=0.05)


def test_walls_with_pockets_are_not_shown_of_a_smooth_bore(folder):
    assert [shape.group for shape in scene_shapes(folder, "smooth")] == ["track"]


def test_the_lining_alone_is_there_at_once(folder):
    assert np.ptp(lining_shape(folder, "pockets").vertices[:, 2]) == pytest.approx(10.0)


@pytest.mark.parametrize(("lining", "names"), [("furnished", "scene_furnished.xml"), ("pockets", "scene.xml")])
def test_a_missing_or_spoiled_scene_is_named(folder, tmp_path, lining, names):
    if lining == "pockets":
        (tmp_path / "scene.xml").write_text("<mujoco><geom/></mujoco>")
    with pytest.raises(TunnelError, match=names):
        scene_shapes(tmp_path, lining)
