"""The scene as MJCF that MuJoCo and MJX both load.

Meshes are for looks and rays; bodies collide with boxes, since MuJoCo collides a mesh as its convex hull.
`scene.writing.markup` says which bits of a body's `conaffinity` make it touch what.
"""

from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree as ET

import trimesh

from scene.bore import Bore
from scene.writing.dressing import add_cameras, add_lights, add_materials, add_scout, make_root
from scene.writing.furnished import Furnished
from scene.writing.furniture import FurnitureConfig
from scene.writing.markup import LOW_WALL, SOLID, SceneParts, add_box, add_element, add_mesh
from scene.writing.mesh import has_rings, split_lining, split_skin
from scene.writing.planar import Walls
from scene.writing.track import Track
from scene.writing.trackgeoms import add_nails, add_slabs, add_track
from scene.writing.walls import add_low_panels, add_niche, add_patches

_NEAR_NICHE = 1.0  # m
_MATERIAL = {"lining": "concrete", "recess": "recess", "floor": "floor"}


@dataclass(frozen=True)
class SceneConfig:
    """Cutting and dressing of the scene."""

    chunk_length: float = 20.0  # Length of one mesh of the lining, m.
    robot_radius: float = 0.4  # Radius of the scout, m.
    lidar_height: float = 0.7  # Height of its LiDAR above the top of the sleepers, m.
    furniture: FurnitureConfig = field(default_factory=FurnitureConfig)  # Furniture of the variant `furnished`.


def write_scene(
    folder: Path,
    name: str,
    bore: Bore,
    lining: trimesh.Trimesh,
    walls: Walls,
    track: Track,
    config: SceneConfig,
    furnished: Furnished | None = None,
) -> dict[str, int]:
    """Writes `scene.xml` and the meshes it draws; returns the number of each asset.

    With furniture the file is `scene_furnished.xml`. It shares the meshes that a call without furniture has written
    into the same folder. `walls` are those at the LiDAR's height.
    """
    root = make_root(name)
    parts = SceneParts(add_element(root, "asset"), add_element(root, "worldbody"), folder / "meshes")
    parts.meshes.mkdir(exist_ok=True)
    world = parts.world
    add_materials(parts, rings=has_rings(bore), reuse=furnished is not None)
    count = {"sleepers": len(track.sleeper_station), "rails": 0, "pads": 0, "fasteners": 0}
    count["lining_chunks"] = _add_lining(parts, bore, lining, track, config.chunk_length, furnished)
    openings = furnished.openings if furnished else []
    count["wall_panels"] = add_patches(world, bore, track, openings)
    count["low_wall_panels"] = add_low_panels(world, walls, bore, track, furnished.niches if furnished else [])
    add_slabs(world, bore, track)
    if track.lines:
        add_track(parts, bore.axis, track)
        count |= {
            "rails": 2 * len(track.lines),
            "pads": 2 * len(track.sleeper_station),
            "fasteners": 4 * len(track.sleeper_station),
        }
    count["nails"] = add_nails(parts, bore, config.chunk_length)
    if furnished:
        _add_furniture(world, furnished)
    count["lights"] = add_lights(world, bore, track, config.furniture.lamp_spacing)
    add_cameras(world, bore, track)
    add_scout(world, bore, track, config.robot_radius, config.lidar_height)
    ET.indent(root)
    path = folder / ("scene_furnished.xml" if furnished else "scene.xml")
    path.write_text(ET.tostring(root, encoding="unicode") + "\n")
    return count


def _add_lining(
    parts: SceneParts, bore: Bore, lining: trimesh.Trimesh, track: Track, length: float, furnished: Furnished | None
) -> int:
    """Adds the lining in chunks of a length, m, with the meshes of `scene.xml` where no niche is near."""
    chunks = split_lining(lining, bore, length)
    for k, chunk in enumerate(chunks):
        first, last = k * length, (k + 1) * length
        own = furnished is not None and any(
            a - _NEAR_NICHE < last and first < b + _NEAR_NICHE for a, b in furnished.niches
        )
        for part, (mesh, coordinates) in split_skin(chunk, bore, track.bed).items():
            name = f"{part}_{k:03d}{'_niche' if own else ''}"
            reuse = not own and furnished is not None
            add_mesh(parts, name, mesh, _MATERIAL[part], "0", coordinates, reuse)
    return len(chunks)


def _add_furniture(world: ET.Element, furnished: Furnished) -> None:
    for k, piece in enumerate(furnished.pieces):
        bits = SOLID | LOW_WALL if piece.low else SOLID
        name = f"{piece.kind}_{k:05d}"
        add_box(world, name, piece.half, piece.centre, piece.rotation, bits, group="1", material=piece.material)
    for k, corners in enumerate(furnished.niche_corners):
        add_niche(world, f"niche_{k:02d}", corners)
