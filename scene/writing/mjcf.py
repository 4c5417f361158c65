"""The scene as MJCF that MuJoCo and MJX both load.

Meshes are for looks and rays; bodies collide with boxes, since MuJoCo collides a mesh as its convex hull.
`subterra_jax.host.rover` says which bits of a body's `conaffinity` make it touch what.
"""

import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scene.bore import Bore
from scene.writing.furnished import Furnished, FurnitureConfig
from scene.writing.markup import SceneParts, add_box, add_mesh, format_numbers, format_quaternion
from scene.writing.mesh import has_rings, split_lining, split_skin
from scene.writing.planar import Walls
from scene.writing.track import Track
from scene.writing.trackgeoms import add_nails, add_slabs, add_track
from scene.writing.walls import add_low_panels, add_niche, add_patches
from subterra_jax.host import rover
from subterra_jax.host.rover import LOW_WALL, SOLID

_SEGMENTS = 6  # of a ring
_STONES = 900  # in the picture of the ballast


def write_png(path: Path, picture: UInt8[np.ndarray, "height width 3"]) -> None:
    """Writes an RGB picture as PNG."""
    height, width, _ = picture.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), picture.reshape(height, -1)], axis=1)

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def concrete_picture(rings: bool, height: int = 512, width: int = 2048) -> UInt8[np.ndarray, "height width 3"]:
    """Draws one turn of a lining to the right and two rings upwards; joints only where there are rings."""
    shade = 0.62 + 0.020 * _noise((height, width), (1.0, 1.0), 0) + 0.030 * _noise((height, width), (24.0, 30.0), 1)
    shade += 0.030 * _noise((height, width), (5.0, 90.0), 2)  # what water leaves on its way down
    if rings:
        v, u = np.arange(height)[:, None] / height, np.arange(width)[None, :] / width
        ring = (v * 2).astype(int)
        tone = 0.02 * np.random.default_rng(3).standard_normal((2, _SEGMENTS))
        place = u * _SEGMENTS + 0.5 * ring
        shade += tone[ring, place.astype(int) % _SEGMENTS]
        across = np.abs((v * 2 + 0.5) % 1 - 0.5) * height / 2
        along = np.abs((place + 0.5) % 1 - 0.5) * width / _SEGMENTS
        joint = np.minimum(across + 0 * along, along * 2)
        shade -= 0.25 * np.exp(-((joint / 2.5) ** 2)) + 0.06 * np.exp(-((joint / 12.0) ** 2))
    return _tint(shade, (1.0, 0.985, 0.95))


def ballast_picture(size: int = 512) -> UInt8[np.ndarray, "size size 3"]:
    """Draws broken stone seen from above, repeating at its edges."""
    rng = np.random.default_rng(4)
    stone = rng.random((_STONES, 2))
    tone = 0.40 + 0.09 * rng.standard_normal(_STONES)
    pixel = (np.indices((size, size)).reshape(2, -1).T + 0.5) / size
    distance, nearest = cKDTree(stone, boxsize=1.0).query(pixel, 2)
    edge = np.clip((distance[:, 1] - distance[:, 0]) * size / 9.0, 0.0, 1.0)
    tilt = ((pixel - stone[nearest[:, 0]] + 0.5) % 1 - 0.5) @ [1.0, 0.6] * 3.0
    shade = (tone[nearest[:, 0]] + tilt) * (0.35 + 0.65 * edge)
    return _tint(shade.reshape(size, size), (1.0, 0.96, 0.91))


def _noise(shape: tuple[int, int], sigma: tuple[float, float], seed: int) -> Float[np.ndarray, "height width"]:
    """Smoothed noise of unit variance that repeats at the edges."""
    white = np.fft.rfft2(np.random.default_rng(seed).standard_normal(shape))
    v, u = np.fft.fftfreq(shape[0])[:, None] * sigma[0], np.fft.rfftfreq(shape[1])[None, :] * sigma[1]
    field = np.fft.irfft2(white * np.exp(-2 * np.pi**2 * (v**2 + u**2)), shape)
    return field / field.std()


def _tint(shade: np.ndarray, tint: tuple[float, float, float]) -> np.ndarray:
    return np.clip(255 * shade[..., None] * np.array(tint), 0, 255).astype(np.uint8)


LIT = 7  # OpenGL lights a scene with eight lights, of which the viewer's headlight is one
_COLOURS = {
    "sleeper": "0.66 0.65 0.62 1",
    "recess": "0.34 0.335 0.325 1",
    "steel": "0.30 0.24 0.20 1",
    "rail_head": "0.62 0.60 0.58 1",
    "bolt": "0.25 0.22 0.20 1",
    "concrete_slab": "0.58 0.57 0.54 1",
    "galvanised": "0.62 0.65 0.68 1",
    "cable": "0.06 0.06 0.07 1",
    "cover": "0.78 0.62 0.16 1",
    "insulator": "0.45 0.26 0.18 1",
    "plate": "0.95 0.95 0.92 1",
    "door": "0.16 0.36 0.30 1",
}
_SHINY = {"rail_head", "galvanised"}


def make_root(name: str, bore: Bore) -> ET.Element:
    """Return the root element with compiler, solver and view: a viewer opens before the portal and looks in."""
    at = bore.axis.at(np.array([_start(bore)]))
    heading = np.rad2deg(np.arctan2(at.tangent[0, 1], at.tangent[0, 0]))
    root = ET.Element("mujoco", model=name)
    ET.SubElement(root, "compiler", angle="radian", meshdir="meshes", texturedir="meshes", autolimits="true")
    ET.SubElement(root, "option", timestep="0.004", integrator="implicitfast", iterations="4", ls_iterations="8")
    ET.SubElement(root, "statistic", extent="12", center=format_numbers(at.position[0]))
    visual = ET.SubElement(root, "visual")
    azimuth = f"{heading:.4g}"
    ET.SubElement(visual, "global", offwidth="1920", offheight="1080", fovy="60", azimuth=azimuth, elevation="-8")
    ET.SubElement(visual, "quality", offsamples="4")
    ET.SubElement(visual, "headlight", ambient="0.28 0.28 0.29", diffuse="0.32 0.32 0.30", specular="0 0 0")
    ET.SubElement(visual, "map", znear="0.005", zfar="60", fogstart="1.5", fogend="14")
    ET.SubElement(visual, "rgba", fog="0.05 0.05 0.05 1", haze="0.6 0.7 0.8 1")
    return root


def add_materials(parts: SceneParts, rings: bool, reuse: bool) -> None:
    """Adds pictures and materials; joints of segments are drawn only on a lining that has rings."""
    for name, picture in (("concrete", lambda: concrete_picture(rings)), ("ballast", ballast_picture)):
        if not (reuse and (parts.meshes / f"{name}.png").exists()):
            write_png(parts.meshes / f"{name}.png", picture())
    sky = {"builtin": "gradient", "rgb1": "0.55 0.70 0.88", "rgb2": "0.90 0.93 0.96", "width": "64", "height": "384"}
    ET.SubElement(parts.asset, "texture", {"type": "skybox", **sky})
    for name in ("concrete", "ballast"):
        ET.SubElement(parts.asset, "texture", name=name, type="2d", file=f"{name}.png")
    ET.SubElement(parts.asset, "material", name="concrete", texture="concrete", specular="0.15", shininess="0.2")
    ET.SubElement(parts.asset, "material", name="floor", texture="ballast", specular="0")
    ballast = {"texuniform": "true", "texrepeat": "0.7 0.7", "specular": "0"}
    ET.SubElement(parts.asset, "material", {"name": "ballast", "texture": "ballast", **ballast})
    for name, colour in _COLOURS.items():
        gloss = ("0.7", "0.6") if name in _SHINY else ("0.1", "0.1")
        ET.SubElement(parts.asset, "material", name=name, rgba=colour, specular=gloss[0], shininess=gloss[1])
    ET.SubElement(parts.asset, "material", name="lamp", rgba="1 0.97 0.88 1", emission="1")


def add_lights(world: ET.Element, bore: Bore, spacing: float) -> int:
    """Adds a light at every lamp; those nearest the start are on, since few can be at a time."""
    station = np.arange(spacing / 2, bore.length, spacing)
    crown = bore.toward(np.pi / 2)
    at = bore.axis.at(station)
    lamp = at.position + (np.interp(station, bore.station, crown) - 0.5)[:, None] * at.up
    for k, position in enumerate(lamp):
        ET.SubElement(
            world, "light", name=f"lamp_{k:03d}", pos=format_numbers(position), dir="0 0 -1", cutoff="180",
            exponent="0", attenuation="1 0.05 0.03", diffuse="0.95 0.91 0.80", specular="0.25 0.25 0.22",
            castshadow="false", active="true" if k < LIT else "false",
        )  # fmt: skip
    return len(lamp)


def add_cameras(world: ET.Element, bore: Bore, track: Track) -> None:
    """Adds views inwards from both portals, along the track from the middle, and of the wall there."""
    for name, station, ahead, across, height in (
        ("portal_start", 1.0, 1.0, 0.0, 1.9),
        ("middle", bore.length / 2, 1.0, 0.9, 1.7),
        ("wall", bore.length / 2, 0.35, 1.0, 1.6),
        ("portal_end", bore.length - 1.0, -1.0, 0.0, 1.9),
    ):
        at = bore.axis.at(np.array([station]))
        look = ahead * at.tangent[0] if name != "wall" else 0.5 * at.tangent[0] - 0.85 * at.lateral[0]
        look = look / np.linalg.norm(look)
        right = np.cross(look, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        position = at.position[0] + across * at.lateral[0]
        position[2] = np.interp(station, bore.station, track.elevation) + height
        axes = format_numbers([*right, *np.cross(right, look)])
        ET.SubElement(world, "camera", name=name, pos=format_numbers(position), xyaxes=axes, fovy="65")


def _start(bore: Bore) -> float:
    return min(2.0, bore.length / 2)


def add_rover(root: ET.Element, world: ET.Element, bore: Bore, track: Track, lidar_height: float) -> None:
    """Adds the rover with its motors, 2 m into the bore; its LiDAR is `lidar_height` above the sleepers, m."""
    at = bore.axis.at(np.array([_start(bore)]))
    elevation = float(np.interp(at.station[0], bore.station, track.elevation))
    yaw = Rotation.from_euler("z", np.arctan2(at.tangent[0, 1], at.tangent[0, 0]))
    for part in rover.rover_mjcf(lidar_height):
        if part.tag != "worldbody":
            root.append(part)
            continue
        body = part[0]
        body.set("pos", format_numbers([*at.position[0, :2], elevation + rover.HEIGHT]))
        body.set("quat", format_quaternion(yaw))
        world.append(body)
    # MJX tests the pairs that are nearest.
    custom = ET.SubElement(root, "custom")
    for name, most in (("max_geom_pairs", "16"), ("max_contact_points", "24")):
        ET.SubElement(custom, "numeric", name=name, data=most)


_NEAR_NICHE = 1.0  # m
_MATERIAL = {"lining": "concrete", "recess": "recess", "floor": "floor"}


@dataclass(frozen=True)
class SceneConfig:
    """Cutting and dressing of the scene."""

    chunk_length: float = 20.0  # Length of one mesh of the lining, m.
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
    root = make_root(name, bore)
    parts = SceneParts(ET.SubElement(root, "asset"), ET.SubElement(root, "worldbody"), folder / "meshes")
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
    count["lights"] = add_lights(world, bore, config.furniture.lamp_spacing)
    add_cameras(world, bore, track)
    add_rover(root, world, bore, track, config.lidar_height)
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
    for k, item in enumerate(furnished.items):
        bits = SOLID | LOW_WALL if item.low else SOLID
        name = f"{item.kind}_{k:05d}"
        add_box(world, name, item.half, item.centre, item.rotation, bits, group="1", material=item.material)
    for k, corners in enumerate(furnished.niche_corners):
        add_niche(world, f"niche_{k:02d}", corners)
