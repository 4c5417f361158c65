"""Rays against the true mesh, with Embree."""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Float32, UInt8

from scene.survey.mesh import Mesh

_WINDOW = 60.0  # m of progress for which one scene serves
_REACH = 190.0  # m loaded ahead of it, and behind it for LiDARs that look back; the longest range of any


@dataclass(frozen=True)
class Hits:
    """The first surface on each ray.

    Attributes:
        distance: m, infinite where nothing is hit.
        cosine: Of the incidence angle; negative where the surface is hit from behind.
        part: `Part` that is hit; meaningless where nothing is.
        normal: Unit normals, towards the air.
    """

    distance: Float32[np.ndarray, "n"]
    cosine: Float32[np.ndarray, "n"]
    part: UInt8[np.ndarray, "n"]
    normal: Float32[np.ndarray, "n 3"]


class Caster:
    """Casts rays at the mesh, of which only the part within range is loaded.

    Embree computes in float32. Coordinates in a scene are therefore relative to a whole-metre point near the carrier,
    which keeps them within some 250 m and their rounding within 0.03 mm.
    """

    def __init__(self, mesh: Mesh, behind: float = 20.0) -> None:
        """Take the mesh.

        Args:
            mesh: True surfaces.
            behind: What is kept behind the carrier, m.
        """
        self._mesh = mesh
        self._behind = behind
        self._window: int | None = None

    def load(self, station: float, near: Float[np.ndarray, "3"]) -> None:
        """Load what can be seen by a carrier at `station`, m, about `near`, m, if it is not yet."""
        window = int(np.floor(station / _WINDOW))
        if window == self._window:
            return
        begin, mesh = window * _WINDOW, self._mesh
        chosen = (mesh.station >= begin - self._behind) & (mesh.station <= begin + _WINDOW + _REACH)
        self._origin = np.floor(near)
        self._part = mesh.part[chosen]
        used, faces = np.unique(mesh.faces[chosen], return_inverse=True)
        vertices = (mesh.vertices[used] - self._origin).astype(np.float32)
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(self._scene, vertices, faces.reshape(-1, 3).astype(np.int32))
        self._window = window

    def cast_loaded(self, origin: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"]) -> Hits:
        """The first surface of the loaded part on each ray.

        Args:
            origin: Survey frame, m.
            direction: Unit vectors, survey frame.
        """
        direction = np.ascontiguousarray(direction, np.float32)
        hit = self._scene.run((origin - self._origin).astype(np.float32), direction, output=True)
        normal, found = hit["Ng"], hit["primID"] >= 0
        size = np.sqrt(np.einsum("ij,ij->i", normal, normal))
        normal = normal / np.where(found, size, 1.0).astype(np.float32)[:, None]
        cosine = -np.einsum("ij,ij->i", normal, direction)
        distance = np.where(found, hit["tfar"], np.float32(np.inf))
        return Hits(distance, cosine, self._part[np.where(found, hit["primID"], 0)], normal)
