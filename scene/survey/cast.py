"""Rays against the true mesh, with Embree."""

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Float32, UInt8

from scene.survey.avia import RANGE_MAX
from scene.survey.mesh import Mesh

_WINDOW = 60.0  # m of progress for which one scene serves
_BEHIND = 20.0  # m kept behind the carrier


class Caster:
    """Casts rays at the mesh, of which only the part within range is loaded.

    Embree computes in float32. Coordinates in a scene are therefore relative to a whole-metre point near the carrier,
    which keeps them within some 250 m and their rounding within 0.03 mm.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self._window: int | None = None

    def _load(self, window: int, near: Float[np.ndarray, "3"]) -> None:
        begin = window * _WINDOW
        mesh, end = self._mesh, begin + _WINDOW + RANGE_MAX
        chosen = (mesh.station >= begin - _BEHIND) & (mesh.station <= end)
        self._origin = np.floor(near)
        self._part = mesh.part[chosen]
        used, faces = np.unique(mesh.faces[chosen], return_inverse=True)
        vertices = (mesh.vertices[used] - self._origin).astype(np.float32)
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(self._scene, vertices, faces.reshape(-1, 3).astype(np.int32))
        self._window = window

    def cast(
        self, station: float, origin: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"]
    ) -> tuple[Float32[np.ndarray, "n"], Float32[np.ndarray, "n"], UInt8[np.ndarray, "n"]]:
        """Distance, cosine of incidence and part of the first surface on each ray.

        Args:
            station: Station of the carrier, m; decides which part of the bore is loaded.
            origin: Survey frame, m.
            direction: Unit vectors, survey frame.

        Returns:
            Distances, m, infinite where nothing is hit; cosines, negative where the surface is hit from behind; `Part`.
        """
        window = int(np.floor(station / _WINDOW))
        if window != self._window:
            self._load(window, origin[0])
        direction = np.ascontiguousarray(direction, np.float32)
        hit = self._scene.run((origin - self._origin).astype(np.float32), direction, output=True)
        normal, found = hit["Ng"], hit["primID"] >= 0
        size = np.sqrt(np.einsum("ij,ij->i", normal, normal))
        cosine = -np.einsum("ij,ij->i", normal, direction) / np.where(found, size, 1.0)
        distance = np.where(found, hit["tfar"], np.float32(np.inf))
        return distance, cosine.astype(np.float32), self._part[np.where(found, hit["primID"], 0)]
