"""Surfaces as triangles around an axis, and boxes among them, such as rails and furniture, to be met by themselves."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int

BOX_FACES = np.array([(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 5, 1), (0, 4, 5), (2, 3, 7), (2, 7, 6),
                       (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)])  # fmt: skip
BOX_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


@dataclasses.dataclass(frozen=True)
class Axis:
    """The centreline of a bore."""

    station: Float[np.ndarray, n]  # uniform stations from 0, m, `(n,)`
    position: Float[np.ndarray, "n 3"]  # positions, m, `(n, 3)`
    tangent: Float[np.ndarray, "n 3"]  # unit vectors of growing station, `(n, 3)`


@dataclasses.dataclass(frozen=True)
class Triangles:
    """A surface: `vertices (v, 3)` in the tunnel frame, m, and `faces (f, 3)`, rows of them."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


def join_surfaces(parts: list[Triangles]) -> Triangles:
    """Join several surfaces into one."""
    before = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + offset for part, offset in zip(parts, before, strict=False)]
    return Triangles(
        np.concatenate([np.empty((0, 3)), *(part.vertices for part in parts)]),
        np.concatenate([np.empty((0, 3), np.int64), *faces]),
    )


_OFF = 2e-5  # m, by which a corner may be off its box: a tunnel's file has whole units
_FLAT = 1e-3  # least volume of a box, as a fraction of what its edges would have if they were square to one another


@dataclasses.dataclass(frozen=True)
class Boxes:
    """Boxes: middles, m, `(k, 3)`, and halves of their three edges as vectors, m, `(k, 3, 3)`."""

    centre: Float[np.ndarray, "k 3"]
    half: Float[np.ndarray, "k 3 3"]

    def pick(self, which: np.ndarray) -> Boxes:
        return Boxes(self.centre[which], self.half[which])

    def corners(self) -> Float[np.ndarray, "k 8 3"]:
        """Return the corners, m."""
        return self.centre[:, None] + np.einsum("ci,kij->kcj", BOX_CORNERS, self.half)

    def seen_from(self, centre: Float[np.ndarray, 3], turn: Float[np.ndarray, "3 3"]) -> Boxes:
        return Boxes((self.centre - centre) @ turn.T, self.half @ turn.T)

    def rows(self) -> Float[np.ndarray, "k 12"]:
        """Return the boxes as `Cells.box` has them, exact for edges that are not quite square to one another."""
        rows = np.linalg.inv(self.half).swapaxes(1, 2)
        return np.concatenate([rows, np.einsum("kij,kj->ki", rows, self.centre)[..., None]], axis=-1).reshape(-1, 12)


def split_boxes(surface: Triangles) -> tuple[Triangles, Boxes]:
    """Return a surface without the boxes in it, and these.

    Boxes are runs of 12 triangles between 8 vertices as `rolled` makes them of track and furniture.
    """
    faces, vertices, n = surface.faces, surface.vertices, len(BOX_FACES)
    nothing = Boxes(np.zeros((0, 3)), np.zeros((0, 3, 3)))
    if len(faces) < n:
        return surface, nothing
    # The first corner of such a run has the lowest number.
    start = np.flatnonzero(
        np.all(faces[: len(faces) - n + 1] - faces[: len(faces) - n + 1, :1] == BOX_FACES[0], axis=1)
    )
    base = faces[start, 0]
    start = start[base + len(BOX_CORNERS) <= len(vertices)]
    run = faces[start[:, None] + np.arange(n)] - faces[start, 0][:, None, None]
    start = start[np.all(run == BOX_FACES, axis=(1, 2))]
    corner = vertices[faces[start, 0][:, None] + np.arange(len(BOX_CORNERS))]
    found = Boxes(corner.mean(axis=1), np.einsum("ci,kcj->kij", BOX_CORNERS, corner) / len(BOX_CORNERS))
    square = np.prod(np.linalg.norm(found.half, axis=-1), axis=-1)
    true = np.abs(found.corners() - corner).max(axis=(1, 2), initial=0.0) < _OFF
    true &= (square > 0.0) & (np.abs(np.linalg.det(found.half)) > _FLAT * square)
    kept = np.ones(len(faces), bool)
    kept[(start[true][:, None] + np.arange(n)).ravel()] = False
    return Triangles(vertices, faces[kept]), found.pick(true)
