"""The lining's triangles as they are drawn: wall, recesses and floor apart, with texture coordinates."""

import numpy as np
import trimesh
from jaxtyping import Float

from scene.bore import Bore
from scene.writing.recess import on_wall
from scene.writing.unrolled import unroll

_FLOOR = 0.15  # of the bed, m
_SEGMENT = (0.8, 2.5)  # lengths of segments, m
_SUNK = 0.03  # behind the smooth wall, m
_LEVEL = 0.8  # least upward part of a floor's normal
_BALLAST = 1.4  # side of the picture of the ballast, m
_BAY = 1.5  # length of half the picture of the concrete where there are no rings, m

Coordinates = tuple[Float[np.ndarray, "t 2"], np.ndarray]


def has_rings(bore: Bore) -> bool:
    """Whether the stations of rings are joints of segments: evenly spaced, as far apart as segments are long."""
    if len(bore.ring_station) < 4:
        return False
    pitch = np.diff(bore.ring_station)
    usual = float(np.median(pitch))
    even = np.abs(pitch / usual - np.rint(pitch / usual)) < 0.1
    return bool(_SEGMENT[0] < usual < _SEGMENT[1] and even.mean() > 0.8)


def skins(
    chunk: trimesh.Trimesh, bore: Bore, bed: Float[np.ndarray, " n"]
) -> dict[str, tuple[trimesh.Trimesh, Coordinates | None]]:
    """A chunk's faces as `lining`, `recess` and `floor`, whichever there are.

    They share no vertices, so that the normals that a renderer smooths do not round off the rims of recesses, and
    within a recess no two faces do.
    """
    station, lateral, up = bore.axis.local(chunk.vertices)
    angle = np.arctan2(up, lateral)
    height = chunk.vertices[:, 2] - np.interp(station, bore.station, bed)
    low = (np.abs(height[chunk.faces]) < _FLOOR).all(axis=1) & (chunk.face_normals[:, 2] > _LEVEL)
    depth = np.linalg.norm(chunk.vertices - on_wall(bore, station, angle), axis=1)
    sunk = (depth[chunk.faces] > _SUNK).any(axis=1) & ~low
    parts: dict[str, tuple[trimesh.Trimesh, Coordinates | None]] = {}
    for name, chosen in (("lining", ~low & ~sunk), ("recess", sunk), ("floor", low)):
        if not chosen.any():
            continue
        if name == "recess":
            flat = chunk.triangles[chosen].reshape(-1, 3)
            parts[name] = trimesh.Trimesh(flat, np.arange(len(flat)).reshape(-1, 3), process=False), None
            continue
        used, corner = np.unique(chunk.faces[chosen], return_inverse=True)
        corner = corner.reshape(-1, 3)
        mesh = trimesh.Trimesh(chunk.vertices[used], corner, process=False)
        if name == "floor":
            parts[name] = mesh, (np.column_stack([lateral[used], station[used]]) / _BALLAST, corner)
        else:
            parts[name] = mesh, _around(bore, station[used], angle[used], corner)
    return parts


def _around(bore: Bore, station: np.ndarray, angle: np.ndarray, corner: np.ndarray) -> Coordinates:
    """One picture a turn and two rings; faces across the seam get coordinates beyond one."""
    plane = unroll(bore)
    u = plane.to_around(angle) / plane.girth
    v = _ring_number(bore, station) / 2
    wraps = np.ptp(u[corner], axis=1) > 0.5
    beyond = wraps[:, None] & (u[corner] < 0.5)
    texture = np.concatenate([np.column_stack([u, v]), np.column_stack([u + 1, v])])
    return texture, corner + len(u) * beyond


def _ring_number(bore: Bore, station: np.ndarray) -> np.ndarray:
    """Rings from the first joint, fractions between joints."""
    joint = bore.ring_station
    if not has_rings(bore):
        return station / _BAY
    pitch = float(np.median(np.diff(joint)))
    number = np.rint((joint - joint[0]) / pitch)
    ends = np.array([joint[0] - 9 * pitch, *joint, joint[-1] + 9 * pitch])
    return np.interp(station, ends, [number[0] - 9, *number, number[-1] + 9])
