"""Faults that put bodies into the bore, or close it."""

from dataclasses import replace

import numpy as np
import trimesh

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.faults.kinds import Fault, Site, fault_kind
from benchmarks.fidelity.meshes import concatenate_meshes

EACH = 36.0  # m, the tunnels on which the points of the controls were set: a longer one gets its share
_WALL_THICKNESS = 0.3  # m
_DEBRIS_RADIUS = 0.3  # m
_PILLAR_SIZE = (0.5, 0.4)  # m along and across the tunnel


def place_box(site: Site, station: float, left: float, up: float, size: tuple[float, float, float]) -> trimesh.Trimesh:
    """Return a box in the frame of the axis, m."""
    position, tangent, side, top = site.line.frames(np.array([station]))
    placement = np.eye(4)
    placement[:3, :3] = np.column_stack([tangent[0], side[0], top[0]])
    placement[:3, 3] = position[0] + left * side[0] + up * top[0]
    return trimesh.creation.box(size, transform=placement)


def add_bodies(candidate: Candidate, parts: list[trimesh.Trimesh]) -> Candidate:
    """Puts closed bodies into the bore; the air volume loses theirs."""
    solid = candidate.solid.copy()
    solid.merge_vertices(digits_vertex=6)
    taken = trimesh.boolean.difference([solid, *parts], engine="manifold", check_volume=False)
    extra = [part for part in (candidate.extra, *parts) if len(part.faces)]
    return replace(candidate, solid=taken, extra=concatenate_meshes(extra))


def _as_long_as(candidate: Candidate) -> int:
    """Return how many times `EACH` m a tunnel is long, at least 1."""
    return max(1, round(candidate.length / EACH))


def _middles(candidate: Candidate) -> list[float]:
    """Return the middle of every `EACH` m, m."""
    count = _as_long_as(candidate)
    return [float(candidate.length * (k + 0.5) / count) for k in range(count)]


@fault_kind("box", "a cube on the wall that is not there", "m", signed=False,
            sides=(0.0, np.pi, np.pi / 4, 3 * np.pi / 4))  # fmt: skip
def add_box(site: Site, fault: Fault) -> Candidate:
    """Puts a cube against the wall in the middle of the fault."""
    bore, station = site.candidate.bore, (fault.start or 0.0) + 0.5 * fault.length
    row = int(np.clip(np.searchsorted(bore.station, station), 0, len(bore.station) - 1))
    column = int(np.argmin(np.abs(np.angle(np.exp(1j * (bore.angle - fault.side))))))
    reach = bore.radius[row, column] - 0.5 * fault.size
    left, up = reach * np.cos(fault.side), reach * np.sin(fault.side)
    return add_bodies(site.candidate, [place_box(site, station, left, up, (fault.size,) * 3)])


@fault_kind("obstacle", "a cube on the track in the middle of every 36 m", "m", signed=False)
def add_obstacles(site: Site, fault: Fault) -> Candidate:
    low = -0.5 * float(np.median(site.candidate.bore.height))
    size = (fault.size,) * 3
    boxes = [place_box(site, at, 0.0, low + 0.1 + 0.5 * fault.size, size) for at in _middles(site.candidate)]
    return add_bodies(site.candidate, boxes)


@fault_kind("barrier", "walls across the section in every 36 m", "count", signed=False)
def add_barriers(site: Site, fault: Fault) -> Candidate:
    bore = site.candidate.bore
    size = (_WALL_THICKNESS, float(bore.width.max()) + 0.5, float(bore.height.max()) + 0.5)
    return add_bodies(site.candidate, [place_box(site, at, 0.0, 0.0, size) for at in _middles(site.candidate)])


@fault_kind("debris", "floating blobs in every 36 m", "count", signed=False)
def add_debris(site: Site, fault: Fault) -> Candidate:
    count = int(fault.size) * _as_long_as(site.candidate)
    station = site.rng.uniform(1.0, site.candidate.length - 1.0, count)
    local = np.column_stack([station, site.rng.uniform(-1.5, 1.5, count), site.rng.uniform(-1.0, 1.5, count)])
    parts = []
    for middle in site.line.point(local):
        blob = trimesh.creation.icosphere(subdivisions=1, radius=_DEBRIS_RADIUS)
        blob.apply_translation(middle)
        parts.append(blob)
    return add_bodies(site.candidate, parts)


@fault_kind("pillars", "pillars beside the track, so far apart", "m", signed=False)
def add_pillars(site: Site, fault: Fault) -> Candidate:
    """Puts pillars beside the track, floor to crown, as landmarks that are not there."""
    bore, length = site.candidate.bore, site.candidate.length
    stations = np.arange(0.5 * min(fault.size, length), length - 1.0, fault.size)
    aside, height = 0.36 * float(np.median(bore.width)), float(np.median(bore.height))
    return add_bodies(site.candidate, [place_box(site, s, aside, 0.0, (*_PILLAR_SIZE, height)) for s in stations])


@fault_kind("mouth", "mouth closed by an end wall", signed=False)
def close_mouth(site: Site, fault: Fault) -> Candidate:
    lining, bore = site.candidate.lining.copy(), site.candidate.bore
    lining.merge_vertices(digits_vertex=6)
    edges, count = np.unique(lining.edges_sorted, axis=0, return_counts=True)
    rim = edges[count == 1]
    middle = lining.vertices[rim].mean(axis=1)
    near = np.abs((middle - bore.position[-1]) @ bore.tangent[-1]) < 0.3
    near &= np.linalg.norm(middle - bore.position[-1], axis=1) < 2.0 * float(bore.radius[-1].max())
    fan = np.column_stack([rim[near], np.full(int(near.sum()), len(lining.vertices))])
    vertices = np.vstack([lining.vertices, bore.position[-1]])
    corner = vertices[fan]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    fan = np.where((normal @ bore.tangent[-1] < 0)[:, None], fan, fan[:, ::-1])
    walled = trimesh.Trimesh(vertices, np.vstack([lining.faces, fan]), process=False)
    return replace(site.candidate, lining=walled)
