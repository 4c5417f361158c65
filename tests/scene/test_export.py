"""The scene for other simulators: the same surface as MuJoCo's, with units, axes, materials and provenance."""

import json
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest
import trimesh

from scene.export import main
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
