"""`python -m scene.export DIR --to glb|usd|sdf`: the scene for a web page, Isaac Sim and Gazebo.

Example: python -m scene.export build/tunnel --to usd --out tunnel.usda

Every drawn geom of the MJCF goes along as triangles, joined by material: lining, bed, sleepers, rails. Metres, z up,
the tunnel frame; `frame.origin` of the manifest, the provenance and the licence stand inside the file. All of it is
static and collides as the triangles that are drawn.
"""

import json
import sys
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import mujoco
import numpy as np
import trimesh
import tyro
from jaxtyping import Float, Int
from trimesh.visual.material import PBRMaterial

from scene.errors import RecordingError, require_input
from scene.inputs import read_manifest
from scene.writing.markup import write_xml
from scene.writing.mesh import join_meshes
from subterra_jax.host.command import parse, run_command
from subterra_jax.host.errors import SubterraError
from subterra_jax.host.files import replace_file, replace_folder, require_file, require_folder

_DRAWN = (0, 1)  # groups of lining and bed, of track and furniture
_AROUND = 32  # corners of a cylinder: 0.5 % of its radius
_ENDINGS = {"glb": (".glb",), "usd": (".usda", ".usdc", ".usd"), "sdf": ()}


@dataclass(frozen=True)
class ExportConfig:
    """The scene for a web page, Isaac Sim and Gazebo."""

    # Scene folder, as `scene.build` writes it.
    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    to: Literal["glb", "usd", "sdf"]  # glTF, OpenUSD with physics schemas, or a Gazebo model folder.
    out: Path | None = None  # File to write, for `sdf` a folder; named after the scene, beside it, if not given.
    furnished: bool = False  # With lineside furniture.
    licence: str = "as that of the recording"  # Licence of the scene, put into the file.


@dataclass(frozen=True)
class Part:
    """Triangles of one material."""

    name: str  # Name of the material.
    vertices: Float[np.ndarray, "v 3"]  # Corners, tunnel frame, m.
    faces: Int[np.ndarray, "f 3"]  # Corner numbers of each triangle.
    colour: tuple[float, float, float, float]  # Red, green, blue and opacity, 0 to 1.
    roughness: float  # 1 for matt, 0 for a mirror.


def read_parts(path: Path) -> list[Part]:
    """Read the drawn geoms of a MJCF, joined by material, in the order of their names.

    Raises:
        RecordingError: The file is missing, or MuJoCo refuses it.
    """
    try:
        model = mujoco.MjModel.from_xml_path(str(require_input(path)))
    except ValueError as error:
        raise RecordingError(f"{path}: MuJoCo refuses the scene ({error})") from error
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    by_material: dict[int, list[trimesh.Trimesh]] = {}
    for geom in np.flatnonzero(np.isin(model.geom_group, _DRAWN)):
        turn, place = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
        vertices, faces = geom_triangles(model, int(geom))
        mesh = trimesh.Trimesh(vertices @ turn.T + place, faces, process=False)
        by_material.setdefault(int(model.geom_matid[geom]), []).append(mesh)
    parts = [_join(model, material, meshes) for material, meshes in by_material.items()]
    return sorted(parts, key=lambda part: part.name)


def geom_triangles(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a geom's corners in its own frame and its triangles."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        return model.mesh_vert[first : first + count].astype(float), model.mesh_face[face : face + faces]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        solid = trimesh.creation.box(2.0 * size)
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        solid = trimesh.creation.cylinder(size[0], 2.0 * size[1], sections=_AROUND)
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        solid = trimesh.creation.capsule(2.0 * size[1], size[0], count=(_AROUND, _AROUND // 2))
    else:
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom)
        raise RecordingError(f"the geom {name!r} is of a kind that has no triangles here")
    return np.asarray(solid.vertices), np.asarray(solid.faces)


def _join(model: mujoco.MjModel, material: int, meshes: list[trimesh.Trimesh]) -> Part:
    whole = join_meshes(meshes)
    vertices, faces = np.asarray(whole.vertices), np.asarray(whole.faces)
    if material < 0:
        return Part("plain", vertices, faces, (0.5, 0.5, 0.5, 1.0), 0.9)
    red, green, blue = (float(value) for value in model.mat_rgba[material, :3] * _texture_mean(model, material))
    opacity = float(model.mat_rgba[material, 3])
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_MATERIAL, material)
    roughness = float(np.clip(1.0 - model.mat_specular[material], 0.05, 1.0))
    return Part(name, vertices, faces, (red, green, blue, opacity), roughness)


def _texture_mean(model: mujoco.MjModel, material: int) -> Float[np.ndarray, "3"]:
    """Return the mean colour of a material's texture, which itself stays behind; white without one."""
    texture = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]
    if texture < 0:
        return np.ones(3)
    channels, first = model.tex_nchannel[texture], model.tex_adr[texture]
    count = model.tex_height[texture] * model.tex_width[texture] * channels
    return model.tex_data[first : first + count].reshape(-1, channels)[:, :3].mean(axis=0) / 255.0


def write_glb(path: Path, parts: list[Part], facts: dict[str, Any]) -> None:
    """Write glTF; its own axis up is y, so that a node turns z up, and its numbers are float32."""
    scene = trimesh.Scene(metadata=facts)
    turn = trimesh.transformations.rotation_matrix(-np.pi / 2, [1.0, 0.0, 0.0])
    for part in parts:
        colour = [round(255 * value) for value in part.colour]
        material = PBRMaterial(name=part.name, baseColorFactor=colour, roughnessFactor=part.roughness,
                               metallicFactor=0.0, doubleSided=True)  # fmt: skip
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        mesh.visual = trimesh.visual.TextureVisuals(material=material)
        scene.add_geometry(mesh, node_name=part.name, geom_name=part.name, transform=turn)
    path.write_bytes(scene.export(file_type="glb"))


def write_usd(path: Path, parts: list[Part], facts: dict[str, Any]) -> None:
    """Write OpenUSD: metres, z up, a mesh for each material with a preview surface and a static collider."""
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt
    except ModuleNotFoundError as error:
        raise RecordingError("USD needs pxr, which is not installed: pip install 'subterra-jax[export]'") from error

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/Tunnel").GetPrim()
    stage.SetDefaultPrim(root)
    for key, value in facts.items():
        root.SetCustomDataByKey(f"subterra_{key}", json.dumps(value) if isinstance(value, list) else value)
    for part in parts:
        mesh = UsdGeom.Mesh.Define(stage, f"/Tunnel/{part.name}")
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(part.vertices.astype(np.float32)))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(part.faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(part.faces.astype(np.int32).ravel()))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateDoubleSidedAttr(True)
        extent = [Gf.Vec3f(*map(float, corner)) for corner in (part.vertices.min(axis=0), part.vertices.max(axis=0))]
        mesh.CreateExtentAttr(extent)
        UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
        UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.none)
        material = UsdShade.Material.Define(stage, f"/Tunnel/Looks/{part.name}")
        shader = UsdShade.Shader.Define(stage, f"/Tunnel/Looks/{part.name}/Surface")
        shader.CreateIdAttr("UsdPreviewSurface")
        shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*part.colour[:3]))
        shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(part.roughness)
        material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    stage.GetRootLayer().Save()


def write_sdf(folder: Path, parts: list[Part], facts: dict[str, Any]) -> None:
    """Write a Gazebo model: `model.sdf`, `model.config` and a mesh for each material."""
    name = str(facts["name"])
    (folder / "meshes").mkdir()
    root = ET.Element("sdf", version="1.9")
    root.append(ET.Comment(f" {json.dumps(facts)} "))
    model = ET.SubElement(root, "model", name=name)
    ET.SubElement(model, "static").text = "true"
    link = ET.SubElement(model, "link", name="tunnel")
    for part in parts:
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        file = folder / "meshes" / f"{part.name}.obj"
        file.write_text(trimesh.exchange.obj.export_obj(mesh, include_normals=False, digits=6))
        uri = f"model://{name}/meshes/{part.name}.obj"
        look = ET.SubElement(_add_shape(link, part, "visual", uri), "material")
        for light in ("ambient", "diffuse"):
            ET.SubElement(look, light).text = " ".join(f"{value:.4g}" for value in part.colour)
        _add_shape(link, part, "collision", uri)
    config = ET.Element("model")
    for key, text in (("name", name), ("version", "1.0"), ("description", json.dumps(facts))):
        ET.SubElement(config, key).text = text
    ET.SubElement(config, "sdf", version="1.9").text = "model.sdf"
    write_xml(folder / "model.sdf", root)
    write_xml(folder / "model.config", config)


def _add_shape(link: ET.Element, part: Part, kind: str, uri: str) -> ET.Element:
    shape = ET.SubElement(link, kind, name=f"{part.name}_{kind}")
    geometry = ET.SubElement(ET.SubElement(shape, "geometry"), "mesh")
    ET.SubElement(geometry, "uri").text = uri
    return shape


def export(config: ExportConfig) -> Path:
    """Write the export whole, or not at all; returns its path.

    Raises:
        SubterraError: The scene is missing or damaged, or the output cannot be written.
    """
    endings = _ENDINGS[config.to]
    out = config.out or config.scene.with_name(f"{config.scene.name}{endings[0] if endings else '-sdf'}")
    if endings:
        require_file(out, *endings)
    else:
        require_folder(out, "model.sdf")
    manifest = read_manifest(config.scene)
    facts = {
        "name": manifest["name"], "provenance": manifest.get("input_provenance", "unknown"), "licence": config.licence,
        "origin": manifest["frame"]["origin"], "crs": manifest["frame"].get("crs") or "not stated",
        "frame": "tunnel frame, z up, m; add origin for the input's frame", "made_by": "Subterra",
    }  # fmt: skip
    parts = read_parts(config.scene / ("scene_furnished.xml" if config.furnished else "scene.xml"))
    if config.to == "sdf":
        with replace_folder(out) as folder:
            write_sdf(folder, parts, facts)
        return out
    with replace_file(out) as fresh:
        # USD tells its kinds apart by the ending.
        file = fresh.with_name(f"{fresh.name}{out.suffix}")
        (write_glb if config.to == "glb" else write_usd)(file, parts, facts)
        file.replace(fresh)
    return out


def main(words: list[str] | None = None) -> int:
    """Runs the command and returns its exit status."""
    config = parse(
        lambda given: tyro.cli(ExportConfig, prog="python -m scene.export", args=given, description=__doc__), words
    )
    return run_command(lambda: print(export(config)), mistakes=(SubterraError,))


if __name__ == "__main__":
    sys.exit(main())
