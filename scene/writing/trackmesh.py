"""Shapes of the track: a sleeper, what fastens rails to it, the boxes of a rail; and nails merged by stretch."""

import numpy as np
import trimesh
from jaxtyping import Float

from scene.bore import Bore
from scene.writing.recess import on_wall
from scene.writing.track import RailProfile, TrackConfig

# Engineering defaults, not sourced: plan size of a pad; cast shoulder; a clip of 20 mm bar, e-shaped from above, from
# its leg in the shoulder to its toe on the rail's foot, as x along the rail, y away from the foot's edge, z above it.
_PAD = (0.18, 0.15)
_SHOULDER, _SHOULDER_AT = (0.07, 0.055, 0.045), 0.045
_CLIP_BAR = 0.020
_CLIP = 0.001 * np.array(
    [
        (-50, 45, 12),
        (35, 45, 12),
        (58, 36, 16),
        (62, 15, 24),
        (45, -4, 30),
        (10, -14, 26),
        (-12, -16, 14),
        (-38, -14, 10),
    ]
)
_BAR_SIDES = 6
_BOLT_SIDES = 6


def sleeper(config: TrackConfig) -> trimesh.Trimesh:
    """A monoblock sleeper about the middle of its top, long axis along y, m; convex."""
    y, z = config.sleeper_length / 2, config.sleeper_height
    top, bottom = config.sleeper_top / 2, config.sleeper_bottom / 2
    corners = [(x, s * y, 0.0) for x in (-top, top) for s in (-1, 1)]
    corners += [(x, s * y, -z) for x in (-bottom, bottom) for s in (-1, 1)]
    return trimesh.convex.convex_hull(np.array(corners))


def rail_boxes(profile: RailProfile) -> list[tuple[float, float, float]]:
    """Foot, web and head of a rail as width, lower and upper edge above its foot, m."""
    neck = profile.height - profile.head_height
    return [
        (profile.foot_width, 0.0, profile.foot_height),
        (profile.web_width, profile.foot_height, neck),
        (profile.head_width, neck, profile.height),
    ]


def fastening(config: TrackConfig) -> trimesh.Trimesh:
    """What holds the rails to one sleeper, about the middle of its top, m: two pads, four shoulders, four clips."""
    parts = []
    for side in (1, -1):
        pad = trimesh.creation.box((*_PAD, config.pad_thickness))
        parts.append(pad.apply_translation((0, side * config.rail_offset, config.pad_thickness / 2)))
        for edge in (1, -1):
            foot = side * config.rail_offset + edge * config.rail.foot_width / 2
            shoulder = trimesh.creation.box(_SHOULDER)
            parts.append(shoulder.apply_translation((0, foot + edge * _SHOULDER_AT, _SHOULDER[2] / 2)))
            path = _CLIP * [edge, edge, 1.0] + [0.0, foot, config.pad_thickness + config.rail.foot_height]
            parts.append(_bar(path, _CLIP_BAR / 2))
    return _merged(parts)


def _bar(path: Float[np.ndarray, "k 3"], radius: float) -> trimesh.Trimesh:
    """A round bar bent along a path, closed at both ends, m."""
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


def nails(bore: Bore, start: float, end: float) -> trimesh.Trimesh | None:
    """The bolts between two stations, m, as prisms behind the wall, for looks. `None` where there is none."""
    chosen = bore.nail[(bore.nail["station"] >= start) & (bore.nail["station"] < end)]
    if not len(chosen):
        return None
    at = bore.axis.at(chosen["station"])
    wall, parts = on_wall(bore, chosen["station"], chosen["angle"]), []
    for k, nail in enumerate(chosen):
        outward = np.cos(nail["angle"]) * at.lateral[k] + np.sin(nail["angle"]) * at.up[k]
        frame = np.eye(4)
        frame[:3, 2], frame[:3, 0] = at.tangent[k], outward
        frame[:3, 1] = np.cross(frame[:3, 2], frame[:3, 0])
        frame[:3, 3] = wall[k] + nail["depth"] * outward
        bolt = trimesh.creation.cylinder(nail["diameter"] / 2, nail["length"], sections=_BOLT_SIDES)
        parts.append(bolt.apply_transform(frame))
    return _merged(parts)


def _merged(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = [part.faces + offset for part, offset in zip(parts, offsets, strict=True)]
    return trimesh.Trimesh(np.concatenate([p.vertices for p in parts]), np.concatenate(faces), process=False)
