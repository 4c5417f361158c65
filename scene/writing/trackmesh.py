"""Triangles of the track: one sleeper for all, rails and fastenings merged by stretch."""

import numpy as np
import trimesh
from jaxtyping import Float

from scene.axis import Axis
from scene.writing.track import RailProfile, Track, TrackConfig

# Engineering defaults, not sourced: plan size of a pad, envelope of an elastic clip.
_PAD = (0.18, 0.15)
_CLIP = (0.09, 0.11, 0.06)


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


def rails(track: Track, axis: Axis, start: float, end: float, step: float = 0.6) -> trimesh.Trimesh:
    """Both rails between two stations, m, as three extruded boxes each."""
    station = np.linspace(start, end, max(int(np.ceil((end - start) / step)), 1) + 1)
    config = track.config
    base = _elevation(track, axis, station) + config.pad_thickness
    at = axis.at(station)
    parts = []
    for side in (1, -1):
        for width, low, high in rail_boxes(config.rail):
            edges = [
                (side * config.rail_offset - width / 2, low),
                (side * config.rail_offset + width / 2, low),
                (side * config.rail_offset + width / 2, high),
                (side * config.rail_offset - width / 2, high),
            ]
            ring = np.stack([_place(at, base, y, z) for y, z in edges], axis=1)
            parts.append(_prism(ring))
    return _merged(parts)


def fastenings(track: Track, axis: Axis, start: float, end: float) -> trimesh.Trimesh | None:
    """Pads and clips of the sleepers between two stations, m; for looks. `None` where there is no sleeper."""
    chosen = track.sleeper_station[(track.sleeper_station >= start) & (track.sleeper_station < end)]
    config, parts = track.config, []
    at, base = axis.at(chosen), _elevation(track, axis, chosen)
    for k in range(len(chosen)):
        frame = np.eye(4)
        frame[:3, 0], frame[:3, 1] = at.tangent[k], at.lateral[k]
        frame[:3, 2] = np.cross(at.tangent[k], at.lateral[k])
        frame[:2, 3], frame[2, 3] = at.position[k, :2], base[k]
        for side in (1, -1):
            pad = trimesh.creation.box((*_PAD, config.pad_thickness))
            pad.apply_translation((0, side * config.rail_offset, config.pad_thickness / 2))
            parts.append(pad.apply_transform(frame))
            for edge in (1, -1):
                clip = trimesh.creation.box(_CLIP)
                across = side * config.rail_offset + edge * (config.rail.foot_width + _CLIP[1]) / 2
                parts.append(clip.apply_translation((0, across, _CLIP[2] / 2)).apply_transform(frame))
    return _merged(parts) if parts else None


def _merged(parts: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = [part.faces + offset for part, offset in zip(parts, offsets, strict=True)]
    return trimesh.Trimesh(np.concatenate([p.vertices for p in parts]), np.concatenate(faces), process=False)


def _elevation(track: Track, axis: Axis, station: np.ndarray) -> np.ndarray:
    return np.interp(station, axis.station, track.elevation)


def _place(at: Axis, base: np.ndarray, across: float, above: float) -> Float[np.ndarray, "k 3"]:
    points = at.position + across * at.lateral
    points[:, 2] = base + above
    return points


def _prism(ring: Float[np.ndarray, "k 4 3"]) -> trimesh.Trimesh:
    k = len(ring)
    corner = np.arange(4 * k).reshape(k, 4)
    a, b = corner[:-1], np.roll(corner[:-1], -1, axis=1)
    c, d = corner[1:], np.roll(corner[1:], -1, axis=1)
    sides = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    caps = [[0, 2, 1], [0, 3, 2], *(corner[-1][[[0, 1, 2], [0, 2, 3]]]).tolist()]
    return trimesh.Trimesh(ring.reshape(-1, 3), np.concatenate([sides, caps]), process=False)
