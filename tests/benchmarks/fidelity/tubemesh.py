"""Triangles of the tube: its wall on a grid whose lines run along the pockets' edges, so that recesses are exact."""

from dataclasses import dataclass

import numpy as np
import trimesh

from benchmarks.fidelity.references import PARTS

_CLEAR = 0.04  # m; no grid line is nearer than this to an edge


@dataclass(frozen=True)
class Section:
    """Flat floor, vertical walls and a round crown, about mid-width and mid-height; m."""

    width: float
    height: float

    @property
    def springing(self) -> float:
        """Height of the crown's centre above mid-height."""
        return (self.height - self.width) / 2

    @property
    def corner(self) -> float:
        """Angle of the foot of the left wall."""
        return float(np.arctan2(-self.height, self.width))

    def radius(self, angle) -> np.ndarray:
        """Distance to the wall at angles from lateral towards up."""
        c, s = np.cos(angle), np.sin(angle)
        with np.errstate(divide="ignore"):
            floor = np.where(s < 0, -0.5 * self.height / np.where(s < 0, s, -1.0), np.inf)
            wall = 0.5 * self.width / np.maximum(np.abs(c), 1e-12)
        crown = self.springing * s + np.sqrt((self.width / 2) ** 2 - (self.springing * c) ** 2)
        return np.minimum(np.where(wall * s <= self.springing, wall, crown), floor)

    def slant(self, angle) -> np.ndarray:
        """Cosine between the ray at an angle and the wall's normal there; of wall and crown only."""
        c, s = np.cos(angle), np.sin(angle)
        at = self.radius(angle)
        on_wall = at * s <= self.springing
        return np.where(on_wall, np.abs(c), (at - self.springing * s) / (self.width / 2))


def _lines(regular: np.ndarray, edges: np.ndarray, clear: float) -> np.ndarray:
    edges = np.unique(np.round(edges, 9))
    if not len(edges):
        return regular
    apart = np.abs(regular[:, None] - edges).min(axis=1) > clear
    return np.unique(np.concatenate([regular[apart], edges]))


def rolled(tube, section: Section) -> tuple[trimesh.Trimesh, trimesh.Trimesh, np.ndarray]:
    """Lining (normals inwards), solid (normals outwards) and the part of each face of the lining."""
    pockets, turn = tube.pockets, 2 * np.pi
    middle = pockets["angle"]
    half = pockets["width"] / 2 / section.radius(middle)
    sides = np.concatenate([middle - half, middle + half]) % turn
    ends = np.concatenate([pockets["station"] + sign * pockets["length"] / 2 for sign in (-1, 1)])
    inner = _lines(np.linspace(0, tube.length, int(tube.length / 0.25) + 1)[1:-1], ends, _CLEAR)
    station = np.concatenate([[0.0], inner, [tube.length]])
    corners = np.array([section.corner, np.pi - section.corner]) % turn
    angle = _lines(np.linspace(0, turn, 90, endpoint=False), np.concatenate([sides, corners]), _CLEAR / 3)
    n, m = len(station), len(angle)
    radius = tube.scale(station)[:, None] * section.radius(angle)
    deep = radius + tube.depth / section.slant(angle)
    s = np.repeat(station, m)

    def at(r: np.ndarray) -> np.ndarray:
        return tube.point(s, (r * np.cos(angle)).ravel(), (r * np.sin(angle)).ravel())

    recessed = _recessed(pockets, station, angle, half)
    index = np.arange(n * m).reshape(n, m)
    sunk = index + n * m
    beside = np.roll(index, -1, axis=1)
    low = [index[:-1], beside[:-1], beside[1:], index[1:]]  # a quad of each cell
    quads = np.stack([np.where(recessed, corner + n * m, corner) for corner in low], axis=-1).reshape(-1, 4)
    floor = section.height / 2 * 0.999 < -(radius * np.sin(angle))[0] / tube.scale(0.0)
    on_floor = np.broadcast_to(floor & np.roll(floor, -1), recessed.shape).ravel()
    part = np.where(recessed.ravel(), PARTS.index("pocket"), np.where(on_floor, PARTS.index("floor"), 0))
    steps = _steps(recessed, index, sunk)
    quads = np.concatenate([quads, steps])
    part = np.concatenate([part, np.full(len(steps), PARTS.index("pocket"))])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    vertices = np.concatenate([at(radius), at(deep), tube.frames([0.0, tube.length])[0]])
    caps = [np.column_stack([np.full(m, 2 * n * m), beside[0], index[0]]),
            np.column_stack([np.full(m, 2 * n * m + 1), index[-1], beside[-1]])]  # fmt: skip
    solid = trimesh.Trimesh(vertices, np.concatenate([faces, *caps]), process=False)
    outwards = solid.volume > 0
    lining = trimesh.Trimesh(vertices, faces[:, ::-1] if outwards else faces, process=False)
    if not outwards:
        solid.invert()
    for mesh in (lining, solid):
        mesh.remove_unreferenced_vertices()
    return lining, solid, np.concatenate([part, part])


def _recessed(pockets: np.ndarray, station: np.ndarray, angle: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Which cells of the grid are pockets."""
    s = (station[1:] + station[:-1]) / 2
    a = angle + (np.roll(angle, -1) - angle) % (2 * np.pi) / 2
    inside = np.zeros((len(s), len(a)), bool)
    for pocket, reach in zip(pockets, half, strict=True):
        along = np.abs(s - pocket["station"]) < pocket["length"] / 2
        round_ = np.abs((a - pocket["angle"] + np.pi) % (2 * np.pi) - np.pi) < reach
        inside |= along[:, None] & round_
    return inside


def _steps(recessed: np.ndarray, index: np.ndarray, sunk: np.ndarray) -> np.ndarray:
    """The sides of the recesses as quads, turned like the cells."""
    quads = []
    i, j = np.nonzero(recessed)
    m = recessed.shape[1]
    ahead = (j + 1) % m
    around = [((i, j), (i, ahead), -1, 0), ((i, ahead), (i + 1, ahead), 0, 1),
              ((i + 1, ahead), (i + 1, j), 1, 0), ((i + 1, j), (i, j), 0, -1)]  # fmt: skip
    for start, end, di, dj in around:
        open_ = ~recessed[np.clip(i + di, 0, len(recessed) - 1), (j + dj) % m]
        edge = [index[start], index[end], sunk[end], sunk[start]]
        quads.append(np.stack(edge, axis=-1)[open_])
    return np.concatenate(quads)
