"""Controls that put things into the bore, or close it."""

from dataclasses import replace

import numpy as np
import trimesh

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.compiled import concatenated
from benchmarks.fidelity.controls.warp import curve

_WALL = 0.3  # m thick
_BLOB = 0.3  # m, radius of a piece of debris
_PILLAR = (0.5, 0.4)  # m along and across the tunnel


def placed_box(
    candidate: Candidate, station: float, left: float, up: float, size: tuple[float, float, float]
) -> trimesh.Trimesh:
    """A box in the frame of the axis, m."""
    position, tangent, side, top = curve(candidate).frames(np.array([station]))
    placement = np.eye(4)
    placement[:3, :3] = np.column_stack([tangent[0], side[0], top[0]])
    placement[:3, 3] = position[0] + left * side[0] + up * top[0]
    return trimesh.creation.box(size, transform=placement)


def with_bodies(candidate: Candidate, parts: list[trimesh.Trimesh]) -> Candidate:
    """The candidate with closed bodies standing in it; the air volume loses what they take."""
    solid = candidate.solid.copy()
    solid.merge_vertices(digits_vertex=6)
    taken = trimesh.boolean.difference([solid, *parts], engine="manifold", check_volume=False)
    extra = [part for part in (candidate.extra, *parts) if len(part.faces)]
    return replace(candidate, solid=taken, extra=concatenated(extra))


def blocked(candidate: Candidate, whole: bool) -> Candidate:
    """A box of 1 m on the track in mid-tunnel, or a wall across the whole section."""
    bore, station = candidate.bore, 0.5 * candidate.length
    width, height = float(bore.width.max()), float(bore.height.max())
    if whole:
        return with_bodies(candidate, [placed_box(candidate, station, 0.0, 0.0, (_WALL, width + 0.5, height + 0.5))])
    low = -0.5 * float(np.median(bore.height))
    return with_bodies(candidate, [placed_box(candidate, station, 0.0, low + 0.6, (1.0, 1.0, 1.0))])


def littered(candidate: Candidate, count: int, rng: np.random.Generator) -> Candidate:
    """Pieces of debris that float in the bore."""
    station = rng.uniform(1.0, candidate.length - 1.0, count)
    local = np.column_stack([station, rng.uniform(-1.5, 1.5, count), rng.uniform(-1.0, 1.5, count)])
    parts = []
    for middle in curve(candidate).point(local):
        blob = trimesh.creation.icosphere(subdivisions=1, radius=_BLOB)
        blob.apply_translation(middle)
        parts.append(blob)
    return with_bodies(candidate, parts)


def pillared(candidate: Candidate, spacing: float) -> Candidate:
    """Pillars beside the track, floor to crown, as landmarks that are not there."""
    bore = candidate.bore
    stations = np.arange(0.5 * min(spacing, candidate.length), candidate.length - 1.0, spacing)
    aside, height = 0.36 * float(np.median(bore.width)), float(np.median(bore.height))
    size = (*_PILLAR, height)
    return with_bodies(candidate, [placed_box(candidate, s, aside, 0.0, size) for s in stations])


def mouth_closed(candidate: Candidate) -> Candidate:
    """An end wall where the tunnel goes on."""
    lining = candidate.lining.copy()
    lining.merge_vertices(digits_vertex=6)
    edges, count = np.unique(lining.edges_sorted, axis=0, return_counts=True)
    rim = edges[count == 1]
    middle = lining.vertices[rim].mean(axis=1)
    bore = candidate.bore
    near = np.abs((middle - bore.position[-1]) @ bore.tangent[-1]) < 0.3
    near &= np.linalg.norm(middle - bore.position[-1], axis=1) < 2.0 * float(bore.radius[-1].max())
    fan = np.column_stack([rim[near], np.full(int(near.sum()), len(lining.vertices))])
    vertices = np.vstack([lining.vertices, bore.position[-1]])
    inward = (
        np.einsum(
            "ij,j->i",
            np.cross(vertices[fan[:, 1]] - vertices[fan[:, 0]], vertices[fan[:, 2]] - vertices[fan[:, 0]]),
            bore.tangent[-1],
        )
        < 0
    )
    fan = np.where(inward[:, None], fan, fan[:, ::-1])
    return replace(candidate, lining=trimesh.Trimesh(vertices, np.vstack([lining.faces, fan]), process=False))
