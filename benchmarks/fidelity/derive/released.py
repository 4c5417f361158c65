"""The released files themselves: hashed, compiled, and what was computed from them kept while they are the same.

Controls that leave scene and planar tunnel alone then cost SCN and PAR nothing.
"""

from collections.abc import Callable
from functools import wraps
from hashlib import sha256
from pathlib import Path
from typing import TypeVar
from xml.etree import ElementTree

import mujoco
import numpy as np

from benchmarks.fidelity.case import SHARED, Case, derived
from benchmarks.fidelity.compiled import Track, track_of

Result = TypeVar("Result")


def of_released(*reads: str) -> Callable[[Callable[[Case], Result]], Callable[[Case], Result]]:
    """Computes a function of released files once in this process for as long as what it reads stays the same.

    Args:
        *reads: Of `scene` (the MJCF with its meshes), `tunnel` (the planar tunnel), `mesh` (visible surface and
            centreline).
    """

    def decorate(function: Callable[[Case], Result]) -> Callable[[Case], Result]:
        @wraps(function)
        def once(case: Case) -> Result:
            hashes = tuple(_HASHES[name](case) for name in reads)
            key = (function.__module__, function.__qualname__, case.seed, case.tolerance, hashes)
            if key not in SHARED:
                SHARED[key] = function(case)
            return SHARED[key]

        return once

    return decorate


@derived
def scene_hash(case: Case) -> str:
    """SHA-256 of the MJCF and of every file that it names."""
    scene = case.candidate.scene
    digest = sha256(scene.read_bytes())
    for path in assets(scene):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


@derived
def tunnel_hash(case: Case) -> str:
    """SHA-256 of the planar tunnel."""
    return sha256(case.candidate.tunnel.read_bytes()).hexdigest()


@derived
def mesh_hash(case: Case) -> str:
    """SHA-256 of the visible surface and the centreline in memory."""
    digest, judged = sha256(case.candidate.bore.position.tobytes()), case.candidate
    track = judged.track
    laid = (track.sleeper_mesh, track.rail_mesh, track.fastening_mesh)
    for mesh in (judged.lining, *laid, judged.extra, judged.nails, judged.bed):
        digest.update(np.ascontiguousarray(mesh.vertices).tobytes() + np.ascontiguousarray(mesh.faces).tobytes())
    return digest.hexdigest()


_HASHES = {"scene": scene_hash, "tunnel": tunnel_hash, "mesh": mesh_hash}


def assets(scene: Path) -> list[Path]:
    """Files that an MJCF names, where they lie."""
    root = ElementTree.parse(scene).getroot()
    compiler = root.find("compiler")
    where = compiler.attrib if compiler is not None else {}
    folders = {kind: scene.parent / where.get(f"{kind}dir", "") for kind in ("mesh", "texture")}
    files = {(kind, one.get("file")) for kind in ("mesh", "texture") for one in root.iter(kind) if one.get("file")}
    return [folders[kind] / str(name) for kind, name in sorted(files)]


@of_released("scene")
def model(case: Case) -> mujoco.MjModel:
    """The compiled scene.

    Raises:
        ValueError: MuJoCo refuses it.
    """
    return mujoco.MjModel.from_xml_path(str(case.candidate.scene))


@of_released("scene")
def track(case: Case) -> Track:
    """The track that the compiled scene holds, whatever the candidate has in memory."""
    return track_of(model(case), case.candidate.manifest)


def placed(model: mujoco.MjModel) -> mujoco.MjData:
    """Data with every geom where the model's first pose puts it."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def robot(model: mujoco.MjModel) -> int:
    """Number of the first body that moves freely.

    Raises:
        ValueError: None does.
    """
    for joint in range(model.njnt):
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            return int(model.jnt_bodyid[joint])
    raise ValueError("no body of the scene moves freely")


def lidar_elevation(case: Case, station: np.ndarray) -> np.ndarray:
    """Height of the environment's LiDAR plane at stations, tunnel frame, m."""
    with np.load(case.candidate.tunnel) as tunnel:
        return np.interp(station, tunnel["station"], tunnel["elevation"]) + float(tunnel["lidar_height"])


def along_axis(case: Case, id: str, count: int, inset: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random stations of the centreline, so that none lies in a ring of vertices.

    Returns:
        Stations (m, `(count,)`), positions on the centreline and unit vectors to the left, `(count, 3)`.
    """
    bore = case.candidate.bore
    station = np.sort(case.rng(id).uniform(bore.station[0] + inset, bore.station[-1] - inset, count))
    position, left = (
        np.stack([np.interp(station, bore.station, column) for column in rows.T], axis=1)
        for rows in (bore.position, bore.lateral)
    )
    return station, position, left / np.linalg.norm(left, axis=1, keepdims=True)
