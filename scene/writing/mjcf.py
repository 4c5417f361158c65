"""The scene as MJCF that MuJoCo and MJX both load.

Meshes are for looks and rays; bodies collide with panels, since MuJoCo collides a mesh as its convex hull. Collision
bits let a body choose what it touches: 1 walls, 2 a smooth deck at the top of the sleepers (for wheels), 4 the ballast
bed, sleepers and rails (for legs).
"""

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from shapely import LineString, Point

from scene.axis import Axis
from scene.bore import Bore
from scene.writing import trackmesh
from scene.writing.mesh import chunks
from scene.writing.planar import Walls
from scene.writing.track import Track

WALLS, DECK, GROUND = 1, 2, 4
_PANEL_TOLERANCE = 0.02
_PANEL_HEIGHT = 2.5
_PANEL_THICKNESS = 0.10
_PANEL_DEPTH = 0.3  # below the top of the sleepers
_SLAB_THICKNESS = 0.20
_SLAB_LENGTH = 4.0
_COORDINATE_DIGITS = 5


@dataclass(frozen=True)
class SceneConfig:
    """How the scene is cut and dressed.

    Attributes:
        chunk_length: Of one mesh of the lining, m.
        robot_radius: Of the scout, m.
        lidar_height: Of its LiDAR above the top of the sleepers, m.
        lidar_beams: Sites that mark its beams.
    """

    chunk_length: float = 20.0
    robot_radius: float = 0.4
    lidar_height: float = 0.7
    lidar_beams: int = 16


def write_scene(
    folder: Path, name: str, bore: Bore, lining: trimesh.Trimesh, walls: Walls, track: Track, config: SceneConfig
) -> dict[str, int]:
    """Writes `scene.xml` and the meshes it draws; returns how many of each asset there are."""
    meshes = folder / "meshes"
    meshes.mkdir(exist_ok=True)
    root = _header(name)
    asset, world = _child(root, "asset"), _child(root, "worldbody")
    _materials(asset)
    count = {"lining_chunks": 0, "sleepers": len(track.sleeper_station), "rails": 0, "fasteners": 0, "wall_panels": 0}
    for k, chunk in enumerate(chunks(lining, bore, config.chunk_length)):
        _mesh_geom(asset, world, meshes, f"lining_{k:03d}", chunk, "concrete", group="0")
        count["lining_chunks"] += 1
    count["wall_panels"] = _add_panels(world, walls, bore, track)
    _add_slabs(world, bore, track)
    if len(track.sleeper_station):
        _add_track(asset, world, meshes, bore.axis, track, config.chunk_length)
        count["rails"], count["fasteners"] = 2, 4 * len(track.sleeper_station)
    _add_scout(world, bore, track, config)
    ET.indent(root)
    (folder / "scene.xml").write_text(ET.tostring(root, encoding="unicode") + "\n")
    return count


def _child(parent: ET.Element, tag: str, **attributes: str) -> ET.Element:
    return ET.SubElement(parent, tag, attributes)


def _numbers(values) -> str:
    return " ".join(f"{value:.6g}" for value in np.ravel(values))


def _header(name: str) -> ET.Element:
    root = ET.Element("mujoco", model=name)
    _child(root, "compiler", angle="radian", meshdir="meshes", autolimits="true")
    _child(root, "option", timestep="0.004", integrator="implicitfast", iterations="4", ls_iterations="8")
    _child(root, "statistic", extent="12")
    visual = _child(root, "visual")
    _child(visual, "global", offwidth="1280", offheight="960")
    _child(visual, "headlight", ambient="0.45 0.45 0.45", diffuse="0.7 0.7 0.66", specular="0 0 0")
    _child(visual, "map", znear="0.005", zfar="40", fogstart="10", fogend="90")
    return root


def _materials(asset: ET.Element) -> None:
    colours = {"concrete": "0.63 0.62 0.58 1", "sleeper": "0.52 0.51 0.49 1", "steel": "0.42 0.36 0.32 1"}
    for name, colour in {**colours, "ballast": "0.36 0.34 0.31 1", "scout": "0.85 0.45 0.10 1"}.items():
        _child(asset, "material", name=name, rgba=colour, specular="0.1", shininess="0.1")


def _mesh_geom(
    asset: ET.Element, world: ET.Element, folder: Path, name: str, mesh: trimesh.Trimesh, material: str, group: str
) -> None:
    """A mesh for looks, stored about its own whole-metre origin so that few digits suffice."""
    origin = np.floor(mesh.vertices.mean(axis=0))
    local = trimesh.Trimesh(mesh.vertices - origin, mesh.faces, process=False)
    text = trimesh.exchange.obj.export_obj(
        local, include_normals=False, include_color=False, include_texture=False, digits=_COORDINATE_DIGITS, header=None
    )
    (folder / f"{name}.obj").write_text(text)
    _child(asset, "mesh", name=name, file=f"{name}.obj", inertia="shell")
    _child(
        world, "geom", name=name, type="mesh", mesh=name, pos=_numbers(origin), material=material, group=group,
        contype="0", conaffinity="0",
    )  # fmt: skip


def _box(world: ET.Element, name: str, size, position, rotation: Rotation, **attributes: str) -> None:
    quaternion = rotation.as_quat()[[3, 0, 1, 2]]
    _child(
        world, "geom", name=name, type="box", size=_numbers(size), pos=_numbers(position), quat=_numbers(quaternion),
        conaffinity="0", **attributes,
    )  # fmt: skip


def _along(start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]) -> Rotation:
    """X from start to end, y horizontal to the left."""
    x = (end - start) / np.linalg.norm(end - start)
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    return Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=1))


def _add_panels(world: ET.Element, walls: Walls, bore: Bore, track: Track) -> int:
    """Invisible boxes behind both walls at the robots' height, within 2 cm of the wall polyline."""
    count = 0
    for side, name, wall, station in (
        (1, "left", walls.left, walls.left_station),
        (-1, "right", walls.right, walls.right_station),
    ):
        line = LineString(wall)
        kept = np.asarray(line.simplify(_PANEL_TOLERANCE).coords)
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(wall, axis=0), axis=1))])
        kept_station = np.interp([line.project(Point(vertex)) for vertex in kept], arc, station)
        middle_height = np.interp(kept_station, bore.station, track.elevation) + _PANEL_HEIGHT / 2 - _PANEL_DEPTH
        ends = np.column_stack([kept, middle_height])
        for k in range(len(ends) - 1):
            rotation = _along(ends[k], ends[k + 1])
            middle = (ends[k] + ends[k + 1]) / 2 + rotation.apply([0, side * _PANEL_THICKNESS / 2, 0])
            size = (np.linalg.norm(ends[k + 1] - ends[k]) / 2 + 0.01, _PANEL_THICKNESS / 2, _PANEL_HEIGHT / 2)
            _box(world, f"wall_{name}_{k:03d}", size, middle, rotation, contype=str(WALLS), group="3")
            count += 1
    return count


def _add_slabs(world: ET.Element, bore: Bore, track: Track) -> None:
    """The bed (seen only where it is a slab above the lining) and the deck, in straight pieces along the grade."""
    axis = bore.axis
    station = np.linspace(0.0, bore.length, max(int(np.ceil(bore.length / _SLAB_LENGTH)), 1) + 1)
    at = axis.at(station)
    half = track.config.sleeper_length / 2 + track.config.shoulder if track.raised else float(bore.width.max()) / 2
    for name, level, bit in (("bed", track.bed, GROUND), ("deck", track.elevation, DECK)):
        top = at.position.copy()
        top[:, 2] = np.interp(station, bore.station, level)
        seen = {"group": "0", "material": "ballast"} if name == "bed" and track.raised else {"group": "3"}
        for k in range(len(station) - 1):
            rotation = _along(top[k], top[k + 1])
            middle = (top[k] + top[k + 1]) / 2 - rotation.apply([0, 0, _SLAB_THICKNESS / 2])
            size = (np.linalg.norm(top[k + 1] - top[k]) / 2 + 0.02, half, _SLAB_THICKNESS / 2)
            _box(world, f"{name}_{k:03d}", size, middle, rotation, contype=str(bit), **seen)


def _add_track(
    asset: ET.Element, world: ET.Element, meshes: Path, axis: Axis, track: Track, chunk_length: float
) -> None:
    (meshes / "sleeper.obj").write_text(
        trimesh.exchange.obj.export_obj(trackmesh.sleeper(track.config), include_normals=False, digits=5, header=None)
    )
    _child(asset, "mesh", name="sleeper", file="sleeper.obj")
    at = axis.at(track.sleeper_station)
    for k, z in enumerate(np.interp(track.sleeper_station, axis.station, track.elevation)):
        frame = Rotation.from_matrix(
            np.stack([at.tangent[k], at.lateral[k], np.cross(at.tangent[k], at.lateral[k])], axis=1)
        )
        _child(
            world, "geom", name=f"sleeper_{k:04d}", type="mesh", mesh="sleeper", material="sleeper", group="1",
            pos=_numbers([*at.position[k, :2], z]), quat=_numbers(frame.as_quat()[[3, 0, 1, 2]]),
            contype=str(GROUND), conaffinity="0",
        )  # fmt: skip
    _add_rail_boxes(world, axis, track)
    edges = np.append(np.arange(0.0, axis.length - 1e-6, chunk_length), axis.length + 1e-6)
    for k in range(len(edges) - 1):
        merged = trackmesh.fastenings(track, axis, edges[k], edges[k + 1])
        if merged is not None:
            _mesh_geom(asset, world, meshes, f"fastenings_{k:03d}", merged, "steel", group="1")


def _add_rail_boxes(world: ET.Element, axis: Axis, track: Track) -> None:
    """Rails as boxes, foot, web and head, over stretches short enough for the curve."""
    config = track.config
    station = np.linspace(0.0, axis.length, max(int(np.ceil(axis.length / 3.0)), 1) + 1)
    at = axis.at(station)
    base = np.interp(station, axis.station, track.elevation) + config.pad_thickness
    for side, name in ((1, "left"), (-1, "right")):
        foot = at.position + side * config.rail_offset * at.lateral
        foot[:, 2] = base
        for k in range(len(station) - 1):
            rotation = _along(foot[k], foot[k + 1])
            half = float(np.linalg.norm(foot[k + 1] - foot[k])) / 2
            for part, (width, low, high) in zip(
                ("foot", "web", "head"), trackmesh.rail_boxes(config.rail), strict=True
            ):
                middle = (foot[k] + foot[k + 1]) / 2 + rotation.apply([0, 0, (low + high) / 2])
                size = (half, width / 2, (high - low) / 2)
                _box(
                    world, f"rail_{name}_{k:03d}_{part}", size, middle, rotation,
                    contype=str(GROUND), group="1", material="steel",
                )  # fmt: skip


def _add_scout(world: ET.Element, bore: Bore, track: Track, config: SceneConfig) -> None:
    """A round robot of the environment's size on four smooth casters, 2 m into the bore."""
    at = bore.axis.at(np.array([min(2.0, bore.length / 2)]))
    elevation = float(np.interp(at.station[0], bore.station, track.elevation))
    yaw = Rotation.from_euler("z", np.arctan2(at.tangent[0, 1], at.tangent[0, 0]))
    body = _child(
        world, "body", name="scout", pos=_numbers([*at.position[0, :2], elevation + 0.01]),
        quat=_numbers(yaw.as_quat()[[3, 0, 1, 2]]),
    )  # fmt: skip
    _child(body, "freejoint", name="scout")
    touch = {"contype": "0", "conaffinity": str(WALLS | DECK), "group": "2", "material": "scout"}
    radius = config.robot_radius
    _child(
        body,
        "geom",
        name="scout_hull",
        type="capsule",
        size=_numbers([radius, 0.08]),
        pos="0 0 0.52",
        mass="40",
        **touch,
    )
    for k, (x, y) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        _child(
            body, "geom", name=f"scout_caster_{k}", type="sphere", size="0.08",
            pos=_numbers([0.22 * x, 0.22 * y, 0.08]), mass="1", friction="0.05 0.005 0.0001", **touch,
        )  # fmt: skip
    _child(body, "site", name="lidar", pos=_numbers([0, 0, config.lidar_height]), size="0.03")
    _child(body, "camera", name="scout", pos="0 0 1.0", xyaxes="0 -1 0 0.1 0 1", fovy="70")
