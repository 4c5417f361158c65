"""The null tube: the best constant section swept along the right axis; whoever knows no detail can make it."""

from dataclasses import replace

import numpy as np
import trimesh
from jaxtyping import Float

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.compiled import Track

CORNERS = 72  # of the swept polygon
STEP = 0.5  # m between rings


def null_tube(candidate: Candidate, sleepers: bool = True) -> Candidate:
    """A candidate with the axis of the given one and its median section everywhere.

    Args:
        candidate: Whose axis, median radius and track are taken.
        sleepers: Whether it keeps the track.
    """
    bore = candidate.bore
    count = max(round(candidate.length / STEP), 2) + 1
    station = np.linspace(bore.station[0], bore.station[-1], count)
    angle = np.linspace(-np.pi, np.pi, CORNERS, endpoint=False)
    radius = np.interp(angle, bore.angle, np.median(bore.radius, axis=0), period=2.0 * np.pi)
    position, left, up = (
        _interpolated(station, bore.station, values) for values in (bore.position, bore.lateral, bore.up)
    )
    lining, solid = swept(position, left, up, radius, angle)
    constant = replace(
        bore,
        width=np.full_like(bore.width, np.median(bore.width)),
        height=np.full_like(bore.height, np.median(bore.height)),
        radius=np.repeat(np.median(bore.radius, axis=0)[None], len(bore.station), axis=0),
        ring_station=bore.ring_station[:0],
        pocket=bore.pocket[:0],
    )
    track = candidate.track if sleepers else without_track()
    name = f"{candidate.name} as null tube" + ("" if sleepers else " without track")
    return replace(
        candidate, name=name, lining=lining, solid=solid, bore=constant, track=track, extra=trimesh.Trimesh(),
        nails=trimesh.Trimesh(), bed=candidate.bed if sleepers else trimesh.Trimesh(),
    )  # fmt: skip


def swept(
    position: Float[np.ndarray, "n 3"],
    left: Float[np.ndarray, "n 3"],
    up: Float[np.ndarray, "n 3"],
    radius: Float[np.ndarray, " m"],
    angle: Float[np.ndarray, " m"],
) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Lining (seen from inside) and solid (normals outward) of one polygon swept along frames."""
    around = radius[:, None] * np.cos(angle)[:, None], radius[:, None] * np.sin(angle)[:, None]
    vertices = position[:, None] + around[0][None] * left[:, None] + around[1][None] * up[:, None]
    rings, corners = vertices.shape[:2]
    here = np.arange(rings - 1)[:, None] * corners + np.arange(corners)[None]
    beside = np.arange(rings - 1)[:, None] * corners + (np.arange(corners) + 1)[None] % corners
    inward = np.concatenate([
        np.stack([here, here + corners, beside], axis=-1).reshape(-1, 3),
        np.stack([beside, here + corners, beside + corners], axis=-1).reshape(-1, 3),
    ])  # fmt: skip
    flat = vertices.reshape(-1, 3)
    lining = trimesh.Trimesh(flat, inward, process=False)
    middle = len(flat)
    caps = [
        _fan(np.arange(corners), middle, reverse=True),
        _fan(np.arange(corners) + (rings - 1) * corners, middle + 1, reverse=False),
    ]
    outward = np.concatenate([inward[:, ::-1], *caps])
    solid = trimesh.Trimesh(np.vstack([flat, position[0], position[-1]]), outward, process=False)
    if solid.volume < 0.0:
        solid.faces, lining.faces = solid.faces[:, ::-1], lining.faces[:, ::-1]
    return lining, solid


def without_track() -> Track:
    """No sleeper, no rail."""
    none = {"left": np.zeros((0, 3)), "right": np.zeros((0, 3))}
    return Track(np.zeros((0, 3)), trimesh.Trimesh(), none, trimesh.Trimesh(), trimesh.Trimesh(), None)


def _fan(ring: np.ndarray, middle: int, reverse: bool) -> np.ndarray:
    fan = np.stack([np.full(len(ring), middle), ring, np.roll(ring, -1)], axis=1)
    return fan[:, ::-1] if reverse else fan


def _interpolated(at: np.ndarray, station: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(at, station, column) for column in values.T], axis=1)
