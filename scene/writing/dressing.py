"""What makes a scene worth looking at: materials, lamps' light, cameras."""

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from scene.bore import Bore
from scene.writing.markup import child, numbers
from scene.writing.texture import ballast, concrete, write_png
from scene.writing.track import Track

LIT = 7  # OpenGL lights a scene with eight lights, of which the viewer's headlight is one
_COLOURS = {
    "sleeper": "0.66 0.65 0.62 1",
    "recess": "0.34 0.335 0.325 1",
    "steel": "0.30 0.24 0.20 1",
    "rail_head": "0.62 0.60 0.58 1",
    "bolt": "0.25 0.22 0.20 1",
    "scout": "0.90 0.42 0.08 1",
    "concrete_slab": "0.58 0.57 0.54 1",
    "galvanised": "0.62 0.65 0.68 1",
    "cable": "0.06 0.06 0.07 1",
    "cover": "0.78 0.62 0.16 1",
    "insulator": "0.45 0.26 0.18 1",
    "plate": "0.95 0.95 0.92 1",
    "door": "0.16 0.36 0.30 1",
}
_SHINY = {"rail_head", "galvanised", "scout"}


def header(name: str) -> ET.Element:
    """The root with compiler, solver and view."""
    root = ET.Element("mujoco", model=name)
    child(root, "compiler", angle="radian", meshdir="meshes", texturedir="meshes", autolimits="true")
    child(root, "option", timestep="0.004", integrator="implicitfast", iterations="4", ls_iterations="8")
    child(root, "statistic", extent="12")
    visual = child(root, "visual")
    child(visual, "global", offwidth="1920", offheight="1080", fovy="60")
    child(visual, "quality", offsamples="4")
    child(visual, "headlight", ambient="0.28 0.28 0.29", diffuse="0.32 0.32 0.30", specular="0 0 0")
    child(visual, "map", znear="0.005", zfar="60", fogstart="1.5", fogend="14")
    child(visual, "rgba", fog="0.05 0.05 0.05 1", haze="0.6 0.7 0.8 1")
    return root


def materials(asset: ET.Element, meshes: Path, rings: bool, reuse: bool) -> None:
    """Pictures and materials; joints of segments are drawn only on a lining that has rings."""
    for name, picture in (("concrete", lambda: concrete(rings)), ("ballast", ballast)):
        if not (reuse and (meshes / f"{name}.png").exists()):
            write_png(meshes / f"{name}.png", picture())
    sky = {"builtin": "gradient", "rgb1": "0.55 0.70 0.88", "rgb2": "0.90 0.93 0.96", "width": "64", "height": "384"}
    child(asset, "texture", type="skybox", **sky)
    for name in ("concrete", "ballast"):
        child(asset, "texture", name=name, type="2d", file=f"{name}.png")
    child(asset, "material", name="concrete", texture="concrete", specular="0.15", shininess="0.2")
    child(asset, "material", name="floor", texture="ballast", specular="0")
    child(asset, "material", name="ballast", texture="ballast", texuniform="true", texrepeat="0.7 0.7", specular="0")
    for name, colour in _COLOURS.items():
        gloss = ("0.7", "0.6") if name in _SHINY else ("0.1", "0.1")
        child(asset, "material", name=name, rgba=colour, specular=gloss[0], shininess=gloss[1])
    child(asset, "material", name="lamp", rgba="1 0.97 0.88 1", emission="1")


def lights(world: ET.Element, bore: Bore, track: Track, spacing: float) -> int:
    """A light at every lamp's place; those nearest the start are on, since few can be at a time."""
    station = np.arange(spacing / 2, bore.length, spacing)
    crown = np.array([np.interp(np.pi / 2, bore.angle, radius, period=2 * np.pi) for radius in bore.radius])
    at = bore.axis.at(station)
    lamp = at.position + (np.interp(station, bore.station, crown) - 0.5)[:, None] * at.up
    for k, position in enumerate(lamp):
        child(
            world, "light", name=f"lamp_{k:03d}", pos=numbers(position), dir="0 0 -1", cutoff="180", exponent="0",
            attenuation="1 0.05 0.03", diffuse="0.95 0.91 0.80", specular="0.25 0.25 0.22", castshadow="false",
            active="true" if k < LIT else "false",
        )  # fmt: skip
    return len(lamp)


def cameras(world: ET.Element, bore: Bore, track: Track) -> None:
    """Views inwards from both portals, along the track from the middle, and of the wall there."""
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
        child(
            world,
            "camera",
            name=name,
            pos=numbers(position),
            xyaxes=numbers([*right, *np.cross(right, look)]),
            fovy="65",
        )
