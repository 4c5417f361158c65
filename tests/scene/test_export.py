"""Exports to other programs, and the tunnel file's bore in three dimensions, are the scene's triangles."""

import json
import xml.etree.ElementTree as ET
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from scene.bore import NAIL
from scene.export import main, read_parts
from scene.writing.folder import write_geometry
from scene.writing.mesh import build_solid
from scene.writing.mjcf import SceneConfig
from scene.writing.planar import cut_walls, half_widths, ring_pitch
from scene.writing.track import TrackConfig, lay_track
from subterra_jax.host.errors import TunnelError
from subterra_jax.lidar3d import rolled, surface
from subterra_jax.tunnel.sources import load_tunnel, read_tunnel
from tests.scene.conftest import ORIGIN

GROUPS = np.array([1, 1, 0, 0, 0, 0], np.uint8)
N = 10_000  # rays


@pytest.fixture(scope="module")
def scene(arc_scene):
    return arc_scene[0]


@pytest.fixture(scope="module")
def rays(scene):
    """Origins in the bore, directions all around, and the distances that MuJoCo finds."""
    model = mujoco.MjModel.from_xml_path(str(scene / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rng = np.random.default_rng(0)
    with np.load(scene / "bore.npz") as bore:
        rows = rng.integers(8, len(bore["station"]) - 8, N)
        origins = bore["position"][rows] + rng.uniform(-0.5, 0.5, (N, 3))
    headings = rng.normal(size=(N, 3))
    headings /= np.linalg.norm(headings, axis=1, keepdims=True)
    distance = np.empty(N)
    geom = np.zeros(1, np.int32)
    for k in range(N):
        distance[k] = mujoco.mj_ray(model, data, origins[k], headings[k], GROUPS, 1, -1, geom)
    return origins, headings, np.where(distance < 0.0, np.inf, distance)


def first_hits(mesh: trimesh.Trimesh, origins: np.ndarray, headings: np.ndarray) -> np.ndarray:
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    places, ray, _ = RayMeshIntersector(mesh).intersects_location(origins, headings, multiple_hits=False)
    distance = np.full(len(origins), np.inf)
    distance[ray] = np.linalg.norm(places - origins[ray], axis=1)
    return distance


def agree(found: np.ndarray, expected: np.ndarray) -> None:
    both = np.isfinite(found) & np.isfinite(expected)
    assert both.mean() > 0.9
    assert np.mean(np.isfinite(found) == np.isfinite(expected)) > 0.999
    assert np.mean(np.abs(found[both] - expected[both]) < 1e-3) > 0.999  # but at edges


def load_usd(path) -> trimesh.Trimesh:
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    facts = stage.GetDefaultPrim().GetCustomData()
    assert facts["subterra_provenance"] == "simulated"
    assert json.loads(facts["subterra_origin"]) == ORIGIN
    meshes = []
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            mesh = UsdGeom.Mesh(prim)
            faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
            meshes.append(trimesh.Trimesh(np.array(mesh.GetPointsAttr().Get()), faces, process=False))
            assert "PhysicsCollisionAPI" in prim.GetAppliedSchemas()
    return trimesh.util.concatenate(meshes)


def load_glb(path) -> trimesh.Trimesh:
    loaded = trimesh.load_scene(path)
    assert loaded.metadata["licence"] == "CC0"
    mesh = loaded.to_mesh()
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1.0, 0.0, 0.0]))  # y up to z up
    return mesh


def load_sdf(path) -> trimesh.Trimesh:
    root = ET.parse(path / "model.sdf").getroot()
    assert root.find("model/static").text == "true"
    uris = [uri.text for uri in root.iter("uri")]
    assert len(uris) == 2 * len(set(uris))  # seen and collided with
    files = sorted({path / uri.removeprefix("model://arc/") for uri in uris})
    return trimesh.util.concatenate([trimesh.load_mesh(file, process=False) for file in files])


@pytest.mark.parametrize(
    ("to", "name", "load"), [("glb", "arc.glb", load_glb), ("usd", "arc.usdc", load_usd), ("sdf", "arc", load_sdf)]
)
def test_rays_meet_the_export_where_they_meet_the_mjcf(scene, rays, tmp_path, to, name, load):
    out = tmp_path / name
    assert main([str(scene), "--to", to, "--out", str(out), "--licence", "CC0"]) == 0
    origins, headings, expected = rays
    agree(first_hits(load(out), origins, headings), expected)


ROUND = """<mujoco><worldbody><geom name="post" type="cylinder" size="0.3 0.5"/>
<geom name="pipe" type="capsule" size="0.3 0.5" pos="3 0 0"/></worldbody></mujoco>"""


def test_round_things_are_as_large_as_they_are_and_plain_without_a_material(tmp_path):
    (tmp_path / "scene.xml").write_text(ROUND)
    (part,) = read_parts(tmp_path / "scene.xml")
    assert (part.name, part.colour, part.roughness) == ("plain", (0.5, 0.5, 0.5, 1.0), 0.9)
    for x, ends, high in ((0.0, 0.0, 0.5), (3.0, 4 / 3 * np.pi * 0.3**3, 0.8)):
        faces = part.faces[np.abs(part.vertices[part.faces].mean(axis=1)[:, 0] - x) < 1]
        solid = trimesh.Trimesh(part.vertices, faces)
        assert solid.volume == pytest.approx(np.pi * 0.3**2 + ends, rel=0.03)
        np.testing.assert_allclose(solid.bounds, [[x - 0.3, -0.3, -high], [x + 0.3, 0.3, high]], atol=1e-3)


@pytest.fixture(scope="module")
def walls(bore):
    laid = lay_track(bore, TrackConfig())
    return {
        name: cut_walls(build_solid(bore, pockets=name == "pockets"), bore, laid.elevation, 0.7)
        for name in ("smooth", "pockets")
    }


def test_smooth_walls_run_at_half_the_width_over_the_whole_length(bore, walls):
    np.testing.assert_allclose(half_widths(walls["smooth"], bore), 2.8, atol=0.005)
    for station in (walls["smooth"].left_station, walls["smooth"].right_station):
        assert station[0] == pytest.approx(0, abs=0.05)
        assert station[-1] == pytest.approx(bore.length, abs=0.05)
        assert (np.diff(station) >= 0).all()


def test_pockets_are_recesses_of_13_cm_with_upright_sides(bore, walls):
    plan = bore.axis.in_plan()
    wall = walls["pockets"].left
    across = plan.local(np.column_stack([wall, np.zeros(len(wall))]))[1]
    assert across.max() == pytest.approx(2.93, abs=0.01)
    assert (across > 2.9).sum() >= 2 * (len(bore.pocket) // 2)


def test_the_ring_pitch_is_that_of_the_joints(bore):
    joints = np.delete(np.arange(0.4, bore.length, 1.4), [3, 9])
    assert ring_pitch(replace(bore, ring_station=joints)) == pytest.approx(1.4)
    assert ring_pitch(replace(bore, ring_station=joints[:0])) == 0.0


def test_a_survey_of_every_fifth_ring_takes_the_pitch_of_the_joints_that_nails_bridge(bore):
    nail = np.zeros(24, NAIL)
    nail["station"] = np.repeat(np.arange(1.5, 18.0, 1.5), 3)[:24] + np.tile([-0.01, 0.0, 0.01], 8)
    surveyed = replace(bore, ring_station=np.arange(0.0, 24.0, 7.0), nail=nail)
    assert ring_pitch(surveyed) == pytest.approx(1.5)


LININGS = ("smooth", "pockets", "furnished")


def scene_triangles(folder, lining):
    """Corners of all that a camera sees in a scene but its clips and bolts, `(t, 3, 3)`, m."""
    model = mujoco.MjModel.from_xml_path(
        str(folder / ("scene_furnished.xml" if lining == "furnished" else "scene.xml"))
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    unseen = {"fastening", "nails"} | ({"lining", "recess", "floor"} if lining == "smooth" else set())
    found = [trimesh.load_mesh(folder / "meshes" / "lining_smooth.ply", process=False).triangles] * (lining == "smooth")
    for k in np.flatnonzero(model.geom_group <= 1):
        geom = model.geom(k)
        if geom.name.split("_")[0] in unseen:
            continue
        if geom.type == mujoco.mjtGeom.mjGEOM_BOX:
            corners = (surface.BOX_CORNERS * geom.size)[surface.BOX_FACES]
        else:
            mesh = model.mesh(model.geom_dataid[k])
            rows = slice(int(mesh.vertadr[0]), int(mesh.vertadr[0] + mesh.vertnum[0]))
            faces = model.mesh_face[int(mesh.faceadr[0]) : int(mesh.faceadr[0] + mesh.facenum[0])]
            corners = model.mesh_vert[rows].astype(float)[faces]
        found.append(corners @ data.geom_xmat[k].reshape(3, 3).T + data.geom_xpos[k])
    return np.concatenate(found)


@pytest.fixture(scope="module")
def built(arc_scene):
    """A scene folder with niches, and its plan."""
    return arc_scene[0], load_tunnel(arc_scene[0] / "tunnel.npz")


def corrupted(folder, target, **changed):
    """A copy of the tunnel file with other fields; those that are `None` are gone."""
    with np.load(folder / "tunnel.npz") as data:
        fields = {name: data[name] for name in data.files} | changed
    np.savez(target, **{name: value for name, value in fields.items() if value is not None})
    return target


@pytest.mark.parametrize("lining", LININGS)
def test_every_corner_of_the_shell_is_one_of_the_scene_and_the_other_way_round(built, lining):
    folder, plan = built
    _, mine = rolled.raise_shell(plan.shell, lining)
    theirs = scene_triangles(folder, lining)
    assert len(mine.faces) == len(theirs)
    middles = mine.vertices[mine.faces].mean(axis=1), theirs.mean(axis=1)
    # Middles of a box's triangles lie elsewhere where its sides are halved along the other diagonal.
    for a, b, most in ((mine.vertices, theirs.reshape(-1, 3), 1e-3), (*middles, 1.0)):
        for near, far in ((a, b), (b, a)):
            gap = cKDTree(far).query(near)[0]
            assert np.median(gap) < 1e-4
            assert gap.max() < most


def test_recesses_that_touch_are_joined_as_in_the_scene(bore, tmp_path):
    rows = bore.pocket.copy()
    rows["station"][4:8] = rows["station"][4:8].mean() + np.array([0.0, 0.0, 0.13, 0.13])
    crowded = replace(bore, pocket=rows[:12])
    write_geometry(tmp_path, "arc", "simulated", crowded, lay_track(crowded, TrackConfig()), SceneConfig())
    _, mine = rolled.raise_shell(load_tunnel(tmp_path / "tunnel.npz").shell, "pockets")
    gap = cKDTree(scene_triangles(tmp_path, "pockets").reshape(-1, 3)).query(mine.vertices)[0]
    assert np.quantile(gap, 0.999) < 1e-3


def test_a_piece_has_its_part_of_the_axis_and_no_point_moves(built):
    whole_axis, whole = rolled.raise_shell(built[1].shell, "pockets")
    axis, surface = rolled.raise_shell(built[1].slice(6.0, 12.0).slice(1.0, 10.0).shell, "pockets")
    assert axis.station[0] == 0.0
    assert axis.station[-1] == pytest.approx(10.0)
    expected = np.stack([np.interp(7.0 + axis.station, whole_axis.station, x) for x in whole_axis.position.T], axis=-1)
    np.testing.assert_allclose(axis.position, expected, atol=1e-9)
    points = [part.vertices[np.unique(part.faces)] for part in (surface, whole)]
    at = [cKDTree(whole_axis.position).query(part)[1] * whole_axis.station[1] for part in points]
    kept = [part[(s > 6.0) & (s < 18.0)] for part, s in zip(points, at, strict=True)]
    assert len(kept[0]) == len(kept[1]) > 1000
    assert cKDTree(kept[0]).query(kept[1])[0].max() < 1e-9
    # Of four points on a circle either diagonal may be taken.
    middles = [part.vertices[part.faces].mean(axis=1) for part in (surface, whole)]
    inside = cKDTree(whole_axis.position).query(middles[1])[1] * whole_axis.station[1]
    gap = cKDTree(middles[0]).query(middles[1][(inside > 7.0) & (inside < 17.0)])[0]
    assert np.mean(gap < 1e-9) > 0.99
    assert len(surface.faces) < 0.9 * len(whole.faces)


def test_a_file_without_the_shell_gives_the_plane(built, tmp_path):
    folder, plan = built
    with np.load(folder / "tunnel.npz") as data:
        shell = {name: None for name in data.files if name.startswith("shell_")}
    flat = read_tunnel(corrupted(folder, tmp_path / "flat.npz", **shell))
    assert flat.shell is None
    np.testing.assert_array_equal(flat.linings["pockets"].left.vertex, plan.linings["pockets"].left.vertex)


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"shell_radius": None}, "field 'shell_radius' is missing"),
        ({"shell_angle": np.zeros(360)}, "field 'shell_angle' must hold at least 8 even directions"),
        ({"shell_unit": np.array(-1e-4)}, "field 'shell_radius' must give positive distances"),
        ({"shell_rise": np.full(98, 1.5)}, "field 'shell_rise' must be above -1"),
        ({"shell_track": np.full((2, 13), np.nan)}, "field 'shell_track' has a value that is not finite"),
        ({"shell_pocket_pockets": np.zeros((2, 4))}, r"field 'shell_pocket_pockets' must have shape \(any, 5\)"),
    ],
)
def test_a_corrupted_field_is_named(built, tmp_path, changed, says):
    assert len(built[1].station) == 98
    with pytest.raises(TunnelError, match=says):
        read_tunnel(corrupted(built[0], tmp_path / "spoiled.npz", **changed))
