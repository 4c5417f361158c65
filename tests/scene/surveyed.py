"""Simulated surveys, and readers of them that share nothing with what wrote them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from plyfile import PlyData
from scipy.spatial.transform import Rotation, Slerp

from scene.survey.__main__ import main

Cast = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Trajectory:
    time: np.ndarray
    position: np.ndarray
    attitude: Rotation

    def at(self, time: np.ndarray) -> tuple[np.ndarray, Rotation]:
        position = np.stack([np.interp(time, self.time, p) for p in self.position.T], axis=-1)
        return position, Slerp(self.time, self.attitude)(time)


def survey(out: Path, *words: object) -> Path:
    """Writes a survey by the command, which must succeed; returns its folder."""
    assert main([*map(str, words), "--out", str(out)]) == 0
    return out


def read_tum(path: Path) -> tuple[np.ndarray, np.ndarray]:
    rows = [line.split() for line in path.read_text().splitlines()]
    return np.array([float(r[0]) for r in rows]), np.array([r[1:] for r in rows], float)


def load_trajectory(path: Path) -> Trajectory:
    time, rows = read_tum(path)
    return Trajectory(time, rows[:, :3], Rotation.from_quat(rows[:, 3:]))


def load_cast(path: Path) -> Cast:
    """Distances along rays into a mesh, m."""
    ply = PlyData.read(path)
    vertices = np.column_stack([ply["vertex"][k] for k in "xyz"])
    origin = np.floor(vertices[0])
    scene = EmbreeScene(robust=True)
    faces = np.vstack(ply["face"]["vertex_indices"])
    TriangleMesh(scene, (vertices - origin).astype(np.float32), faces.astype(np.int32))

    def distance(start: np.ndarray, ray: np.ndarray) -> np.ndarray:
        start, ray = np.broadcast_arrays(start - origin, ray)
        return scene.run(np.array(start, np.float32), np.array(ray, np.float32), query="DISTANCE")

    return distance


def frames(truth: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    position, tangent = np.array(truth["position"]), np.array(truth["tangent"])
    lateral = np.cross([0.0, 0.0, 1.0], tangent)
    lateral /= np.linalg.norm(lateral, axis=1, keepdims=True)
    return position, tangent, lateral, np.cross(tangent, lateral)
