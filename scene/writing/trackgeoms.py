"""The track as meshes and geoms: bed, sleepers, rails, fastenings, nails."""

from xml.etree import ElementTree as ET

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from scene.bore import Bore
from scene.geometry import Axis
from scene.writing import markup
from scene.writing.markup import SceneParts, add_box
from scene.writing.mesh import join_meshes
from scene.writing.track import Line, RailProfile, Track, TrackConfig
from subterra_jax.host.rover import GROUND, RAIL, ROLL, SOLID

# Engineering defaults, not sourced: plan size of a pad; cast shoulder; a clip of 20 mm bar, e-shaped from above, from
# its leg in the shoulder to its toe on the rail's foot, as x along the rail, y away from the foot's edge, z above it.
_PAD = (0.18, 0.15)
_SHOULDER, _SHOULDER_AT = (0.07, 0.055, 0.045), 0.045  # m: along, across, high; from the edge of the foot
_CLIP_BAR = 0.020  # m
_CLIP = 0.001 * np.array([
    (-50, 45, 12), (35, 45, 12), (58, 36, 16), (62, 15, 24), (45, -4, 30), (10, -14, 26),
    (-12, -16, 14), (-38, -14, 10),
])  # fmt: skip
_BAR_SIDES = 6  # of a clip, drawn round
_BOLT_SIDES = 6  # of a nail, drawn round


def sleeper_mesh(config: TrackConfig) -> trimesh.Trimesh:
    """Return a monoblock sleeper about the middle of its top, long axis along y, m; convex."""
    y, z = config.sleeper_length / 2, config.sleeper_height
    top, bottom = config.sleeper_top / 2, config.sleeper_bottom / 2
    corners = [(x, s * y, 0.0) for x in (-top, top) for s in (-1, 1)]
    corners += [(x, s * y, -z) for x in (-bottom, bottom) for s in (-1, 1)]
    return trimesh.convex.convex_hull(np.array(corners))


def rail_boxes(profile: RailProfile) -> list[tuple[float, float, float]]:
    """Return foot, web and head of a rail as width, lower and upper edge above its foot, m."""
    neck = profile.height - profile.head_height
    return [
        (profile.foot_width, 0.0, profile.foot_height),
        (profile.web_width, profile.foot_height, neck),
        (profile.head_width, neck, profile.height),
    ]


def fastening_mesh(config: TrackConfig, rail_offset: float | None = None) -> trimesh.Trimesh:
    """Return the pads, shoulders and clips of one sleeper, about the middle of its top, m.

    Rails lie `rail_offset` m from it, as the configuration says where that is not given.
    """
    parts, aside = [], config.rail_offset if rail_offset is None else rail_offset
    for side in (1, -1):
        pad = trimesh.creation.box((*_PAD, config.pad_thickness))
        parts.append(pad.apply_translation((0, side * aside, config.pad_thickness / 2)))
        for edge in (1, -1):
            foot = side * aside + edge * config.rail.foot_width / 2
            shoulder = trimesh.creation.box(_SHOULDER)
            parts.append(shoulder.apply_translation((0, foot + edge * _SHOULDER_AT, _SHOULDER[2] / 2)))
            path = _CLIP * [edge, edge, 1.0] + [0.0, foot, config.pad_thickness + config.rail.foot_height]
            parts.append(_bent_bar(path, _CLIP_BAR / 2))
    return join_meshes(parts)


def _bent_bar(path: Float[np.ndarray, "k 3"], radius: float) -> trimesh.Trimesh:
    """Return a round bar bent along a path, closed at both ends, m."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    aside = np.cross(along, [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    turn = np.arange(_BAR_SIDES) * 2 * np.pi / _BAR_SIDES
    ring = np.cos(turn)[:, None] * aside[:, None] + np.sin(turn)[:, None] * np.cross(aside, along)[:, None]
    vertex = np.concatenate([(path[:, None] + radius * ring).reshape(-1, 3), path[[0, -1]]])
    corner = np.arange(len(path) * _BAR_SIDES).reshape(len(path), _BAR_SIDES)
    after = np.roll(corner, -1, axis=1)
    a, b, c, d = (part.ravel() for part in (corner[:-1], after[:-1], corner[1:], after[1:]))
    first, last = np.full(_BAR_SIDES, len(vertex) - 2), np.full(_BAR_SIDES, len(vertex) - 1)
    ends = [(first, after[0], corner[0]), (last, corner[-1], after[-1])]
    faces = np.concatenate([np.column_stack(part) for part in [(a, b, c), (b, d, c), *ends]])
    bar = trimesh.Trimesh(vertex, faces, process=False)
    if bar.volume < 0:
        bar.invert()
    return bar


def nail_mesh(bore: Bore, start: float, end: float) -> trimesh.Trimesh | None:
    """Return the bolts between two stations, m, as prisms behind the wall, for looks; `None` without any."""
    chosen = bore.nail[(bore.nail["station"] >= start) & (bore.nail["station"] < end)]
    if not len(chosen):
        return None
    at = bore.axis.at(chosen["station"])
    wall, parts = bore.wall.points(chosen["station"], chosen["angle"]), []
    for k, nail in enumerate(chosen):
        outward = np.cos(nail["angle"]) * at.lateral[k] + np.sin(nail["angle"]) * at.up[k]
        frame = np.eye(4)
        frame[:3, 2], frame[:3, 0] = at.tangent[k], outward
        frame[:3, 1] = np.cross(frame[:3, 2], frame[:3, 0])
        frame[:3, 3] = wall[k] + nail["depth"] * outward
        bolt = trimesh.creation.cylinder(nail["diameter"] / 2, nail["length"], sections=_BOLT_SIDES)
        parts.append(bolt.apply_transform(frame))
    return join_meshes(parts)


_SLAB_THICKNESS = 0.20  # m
_SLAB_LENGTH = 4.0  # m: a chord of a bend stays within its lining
_RAIL_LENGTH = 3.0  # m: the chord of a bend of 150 m is off by 7 mm


def add_slabs(world: ET.Element, bore: Bore, track: Track) -> None:
    """Adds the bed, visible where it is a slab, in straight pieces along the grade."""
    axis = bore.axis
    station = np.linspace(0.0, bore.length, max(int(np.ceil(bore.length / _SLAB_LENGTH)), 1) + 1)
    at = axis.at(station)
    half = track.config.sleeper_length / 2 + track.config.shoulder if track.raised else float(bore.width.max()) / 2
    top = at.position.copy()
    top[:, 2] = np.interp(station, bore.station, track.bed)
    seen = {"group": "0", "material": "ballast"} if track.raised else {"group": "3"}
    for k in range(len(station) - 1):
        rotation = markup.rotation_along(top[k], top[k + 1])
        middle = (top[k] + top[k + 1]) / 2 - rotation.apply([0, 0, _SLAB_THICKNESS / 2])
        half_size = np.array([np.linalg.norm(top[k + 1] - top[k]) / 2 + 0.02, half, _SLAB_THICKNESS / 2])
        add_box(world, f"bed_{k:03d}", half_size, middle, rotation, SOLID | GROUND | ROLL, **seen)


def add_track(parts: SceneParts, axis: Axis, track: Track) -> None:
    """Adds sleepers, their fastenings, and rails; names of a second track have a 2 in them."""
    _add_part(parts, "sleeper", sleeper_mesh(track.config))
    for number, line in enumerate(track.lines, 1):
        mark = "" if number == 1 else f"{number}_"
        mesh = fastening_mesh(track.config, line.rail_offset(track.config.rail))
        _add_part(parts, f"fastening{mark.rstrip('_')}", mesh, inertia="shell")
        _add_sleepers(parts, axis, line, mark)
        _add_rails(parts.world, axis, line, track.config, mark)


def _add_part(parts: SceneParts, name: str, mesh: trimesh.Trimesh, **attributes: str) -> None:
    text = trimesh.exchange.obj.export_obj(mesh, include_normals=False, digits=5, header=None)
    (parts.meshes / f"{name}.obj").write_text(text)
    ET.SubElement(parts.asset, "mesh", {"name": name, "file": f"{name}.obj", **attributes})


def _add_sleepers(parts: SceneParts, axis: Axis, line: Line, mark: str) -> None:
    at = axis.at(line.sleeper_station)
    offset = np.interp(line.sleeper_station, axis.station, line.offset)
    tilt = np.interp(line.sleeper_station, axis.station, line.cant / (line.gauge + 0.07))  # from head to head, m
    for k, z in enumerate(np.interp(line.sleeper_station, axis.station, line.seat)):
        across = at.lateral[k]
        if tilt[k]:
            across = across + np.array([0.0, 0.0, tilt[k]])
            across -= (across @ at.tangent[k]) * at.tangent[k]
            across /= np.linalg.norm(across)
        frame = Rotation.from_matrix(np.stack([at.tangent[k], across, np.cross(at.tangent[k], across)], axis=1))
        place = {
            "pos": markup.format_numbers([*(at.position[k, :2] + offset[k] * at.lateral[k, :2]), z]),
            "quat": markup.format_quaternion(frame),
            "conaffinity": "0",
            "group": "1",
        }
        ET.SubElement(parts.world, "geom", {
            "name": f"sleeper_{mark}{k:04d}", "type": "mesh", "mesh": "sleeper", "material": "sleeper",
            "contype": str(SOLID | GROUND | ROLL), **place,
        })  # fmt: skip
        ET.SubElement(parts.world, "geom", {
            "name": f"fastening_{mark}{k:04d}", "type": "mesh", "mesh": f"fastening{mark.rstrip('_')}",
            "material": "bolt", "contype": "0", **place,
        })  # fmt: skip


def add_nails(parts: SceneParts, bore: Bore, chunk: float) -> int:
    """Adds the bolts that bridge pockets, for looks; returns how many there are."""
    edges = np.append(np.arange(0.0, bore.length - 1e-6, chunk), bore.length + 1e-6)
    for k in range(len(edges) - 1):
        merged = nail_mesh(bore, edges[k], edges[k + 1])
        if merged is not None:
            markup.add_mesh(parts, f"nails_{k:03d}", merged, "bolt", group="1")
    return len(bore.nail)


def _add_rails(world: ET.Element, axis: Axis, line: Line, config: TrackConfig, mark: str) -> None:
    """Adds rails as boxes (foot, web, head) over stretches short enough for the curve."""
    station = np.linspace(0.0, axis.length, max(int(np.ceil(axis.length / _RAIL_LENGTH)), 1) + 1)
    at = axis.at(station)
    rail = config.rail
    taller = line.rail_height - config.pad_thickness - rail.height  # than the standard's
    foot_box, web, head = rail_boxes(rail)
    boxes = (
        (foot_box[0], foot_box[1] - line.footing, foot_box[2]),
        (web[0], web[1], web[2] + taller),
        (head[0], head[1] + taller, head[2] + taller),
    )
    base = np.interp(station, axis.station, line.seat) + config.pad_thickness
    offset, cant = (np.interp(station, axis.station, values) for values in (line.offset, line.cant))
    for side, name in ((1, "left"), (-1, "right")):
        foot = at.position + (offset + side * line.rail_offset(rail))[:, None] * at.lateral
        foot[:, 2] = base + side * cant / 2
        for k in range(len(station) - 1):
            rotation = markup.rotation_along(foot[k], foot[k + 1])
            half = float(np.linalg.norm(foot[k + 1] - foot[k])) / 2
            for part, (width, low, high) in zip(("foot", "web", "head"), boxes, strict=True):
                middle = (foot[k] + foot[k + 1]) / 2 + rotation.apply([0, 0, (low + high) / 2])
                material = "rail_head" if part == "head" else "steel"
                size = (half, width / 2, (high - low) / 2)
                name_part = f"rail_{name}_{mark}{k:03d}_{part}"
                add_box(world, name_part, size, middle, rotation, SOLID | GROUND | RAIL, group="1", material=material)
