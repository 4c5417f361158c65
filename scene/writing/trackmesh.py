"""Shapes of the track: one sleeper for all, the boxes of a rail, fastenings merged by stretch."""

import numpy as np
import trimesh

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
