"""Surfaces as triangles around an axis, and the corners and faces of boxes among them."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

BOX_FACES = np.array([(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 5, 1), (0, 4, 5), (2, 3, 7), (2, 7, 6),
                       (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)])  # fmt: skip
BOX_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


@dataclasses.dataclass(frozen=True)
class Axis:
    """The centreline of a bore."""

    station: Float[np.ndarray, "n"]  # uniform stations from 0, m, `(n,)`
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
