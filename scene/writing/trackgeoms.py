"""The track and what carries it as geoms: bed, deck, sleepers, rails, fastenings, nails."""

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.axis import Axis
from scene.bore import Bore
from scene.writing import trackmesh
from scene.writing.markup import DECK, GROUND, SOLID, along, box, child, mesh_geom, numbers, quaternion
from scene.writing.track import Track

_SLAB_THICKNESS = 0.20
_SLAB_LENGTH = 4.0
_RAIL_LENGTH = 3.0


def add_slabs(world: ET.Element, bore: Bore, track: Track) -> None:
    """The bed (seen only where it is a slab above the lining) and the deck, in straight pieces along the grade."""
    axis = bore.axis
    station = np.linspace(0.0, bore.length, max(int(np.ceil(bore.length / _SLAB_LENGTH)), 1) + 1)
    at = axis.at(station)
    half = track.config.sleeper_length / 2 + track.config.shoulder if track.raised else float(bore.width.max()) / 2
    for name, level, bits in (("bed", track.bed, SOLID | GROUND), ("deck", track.elevation, DECK)):
        top = at.position.copy()
        top[:, 2] = np.interp(station, bore.station, level)
        seen = {"group": "0", "material": "ballast"} if name == "bed" and track.raised else {"group": "3"}
        for k in range(len(station) - 1):
            rotation = along(top[k], top[k + 1])
            middle = (top[k] + top[k + 1]) / 2 - rotation.apply([0, 0, _SLAB_THICKNESS / 2])
            half_size = np.array([np.linalg.norm(top[k + 1] - top[k]) / 2 + 0.02, half, _SLAB_THICKNESS / 2])
            box(world, f"{name}_{k:03d}", half_size, middle, rotation, bits, **seen)


def add_track(asset: ET.Element, world: ET.Element, meshes: Path, axis: Axis, track: Track) -> None:
    """Sleepers, with what fastens the rails to them, and rails."""
    for name, mesh in (("sleeper", trackmesh.sleeper(track.config)), ("fastening", trackmesh.fastening(track.config))):
        text = trimesh.exchange.obj.export_obj(mesh, include_normals=False, digits=5, header=None)
        (meshes / f"{name}.obj").write_text(text)
        child(asset, "mesh", name=name, file=f"{name}.obj", **({} if name == "sleeper" else {"inertia": "shell"}))
    at = axis.at(track.sleeper_station)
    for k, z in enumerate(np.interp(track.sleeper_station, axis.station, track.elevation)):
        frame = Rotation.from_matrix(
            np.stack([at.tangent[k], at.lateral[k], np.cross(at.tangent[k], at.lateral[k])], axis=1)
        )
        place = {"pos": numbers([*at.position[k, :2], z]), "quat": quaternion(frame), "conaffinity": "0", "group": "1"}
        child(
            world, "geom", name=f"sleeper_{k:04d}", type="mesh", mesh="sleeper", material="sleeper",
            contype=str(SOLID | GROUND), **place,
        )  # fmt: skip
        child(
            world, "geom", name=f"fastening_{k:04d}", type="mesh", mesh="fastening", material="bolt", contype="0",
            **place,
        )  # fmt: skip
    _add_rails(world, axis, track)


def add_nails(asset: ET.Element, world: ET.Element, meshes: Path, bore: Bore, chunk: float) -> int:
    """The bolts that bridge pockets, for looks; returns how many there are."""
    edges = chunk_edges(bore.length, chunk)
    for k in range(len(edges) - 1):
        merged = trackmesh.nails(bore, edges[k], edges[k + 1])
        if merged is not None:
            mesh_geom(asset, world, meshes, f"nails_{k:03d}", merged, "bolt", group="1")
    return len(bore.nail)


def chunk_edges(length: float, chunk: float) -> Float[np.ndarray, " k"]:
    """Stations from 0 to the length, `chunk` m apart, the last a little beyond."""
    return np.append(np.arange(0.0, length - 1e-6, chunk), length + 1e-6)


def _add_rails(world: ET.Element, axis: Axis, track: Track) -> None:
    """Rails as boxes, foot, web and head, over stretches short enough for the curve."""
    config = track.config
    station = np.linspace(0.0, axis.length, max(int(np.ceil(axis.length / _RAIL_LENGTH)), 1) + 1)
    at = axis.at(station)
    base = np.interp(station, axis.station, track.elevation) + config.pad_thickness
    for side, name in ((1, "left"), (-1, "right")):
        foot = at.position + side * config.rail_offset * at.lateral
        foot[:, 2] = base
        for k in range(len(station) - 1):
            rotation = along(foot[k], foot[k + 1])
            half = float(np.linalg.norm(foot[k + 1] - foot[k])) / 2
            for part, (width, low, high) in zip(
                ("foot", "web", "head"), trackmesh.rail_boxes(config.rail), strict=True
            ):
                middle = (foot[k] + foot[k + 1]) / 2 + rotation.apply([0, 0, (low + high) / 2])
                material = "rail_head" if part == "head" else "steel"
                size = (half, width / 2, (high - low) / 2)
                name_part = f"rail_{name}_{k:03d}_{part}"
                box(world, name_part, size, middle, rotation, SOLID | GROUND, group="1", material=material)
