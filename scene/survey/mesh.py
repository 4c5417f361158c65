"""Triangles that know what they are part of and where along the bore they lie."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float, Int, UInt8


class Part(IntEnum):
    """What a triangle belongs to; the values stand in `truth.ply` as `part`."""

    LINING = 0
    JOINT = 1
    POCKET = 2
    NAIL = 3
    FLOOR = 4
    SLEEPER = 5
    RAIL = 6
    FASTENING = 7


@dataclass(frozen=True)
class Mesh:
    """Triangles with normals towards the air.

    Attributes:
        vertices: Survey frame, m.
        faces: Vertices of each triangle, anticlockwise seen from the air.
        part: `Part` of each triangle.
        station: Station of each triangle, good to about a metre, m.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    part: UInt8[np.ndarray, "f"]
    station: Float[np.ndarray, "f"]


def join(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of all triangles; vertices are not merged."""
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=True)]),
        np.concatenate([m.part for m in meshes]),
        np.concatenate([m.station for m in meshes]),
    )
