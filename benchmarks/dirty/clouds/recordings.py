"""Recordings with one mistake each in what comes along with them: poses, calibration, clock."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from plyfile import PlyData
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.command import BenchmarkError

LENGTH = 30.0  # m
_LINING = 0  # number of the lining among the parts of `truth.ply`
SUFFIX = {"avia": "", "vlp16": "_vlp16", "os1": "_os1"}
_BESIDE = np.array([-14.0, -9.0, -6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0, 9.0])  # m: from where a place may have been seen
_CLEAR = 0.03  # m by which a ray may fall short of what it sees
_WALL_FROM = 0.5  # m above the floor
_MOST = 6000

Rows = np.ndarray  # (n, 8): t x y z qx qy qz qw
Spoil = Callable[[Rows], Rows]


def simulate_survey(
    folder: Path, seed: int, truth: str = "paper", length: float = LENGTH, sensors: tuple[str, ...] = ("avia",)
) -> None:
    """Simulates a survey, unless it is there already.

    Raises:
        BenchmarkError: The survey fails.
    """
    if all((folder / f"survey{SUFFIX[name]}.bag").is_file() for name in sensors):
        return
    words = ["--truth", truth, "--length", f"{length:g}", "--seed", str(seed), "--out", str(folder)]
    words += ["--scan-every", "4", "--sensors", *sensors]
    done = subprocess.run([sys.executable, "-m", "scene.survey", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise BenchmarkError(f"{folder}: the survey failed: {done.stderr.strip().splitlines()[-1:]}")


def survey_truth(folder: Path, rng: np.random.Generator) -> dict[str, Any]:
    """Return the fields of the truth of a simulated survey: of the wall, what the carrier could see on the way."""
    truth = json.loads((folder / "truth.json").read_text())
    axis = np.array(truth["position"])
    mesh = PlyData.read(folder / "truth.ply")
    vertices = np.column_stack([mesh["vertex"][k] for k in "xyz"])
    faces = np.vstack(mesh["face"]["vertex_indices"])[np.asarray(mesh["face"]["part"]) == _LINING]
    centre = vertices[faces].mean(axis=1)
    near = cKDTree(axis).query(centre)[1]
    sleepers = np.array(truth["sleepers"]["position"]).reshape(-1, 3)
    tracks = {0: "none", 1: "single"}.get(len(truth.get("tracks", [0.0])), "double")
    uneven = bool(np.any(truth.get("aside", [0.0])))
    half = 0.5 * np.array(truth["height_smooth"])
    station = np.array(truth["station"])
    above = centre[:, 2] - axis[near, 2] + half[near]
    inside = (above > _WALL_FROM) & (station[near] > 2.0) & (station[near] < truth["length"] - 3.0)
    chosen = rng.choice(np.flatnonzero(inside), 2 * _MOST, replace=False)
    chosen = chosen[seen_on_the_way(folder, centre[chosen])][:_MOST]
    return {
        "axis": axis, "wall": centre[chosen], "span": np.array([2.0, truth["length"] - 3.0]),
        "ends": np.array([0.0, truth["length"]]), "axis_above_floor": half, "width": np.array(truth["width"]),
        "height": np.array(truth["height"]), "track": tracks, "gauge": truth["rails"]["gauge"],
        "sleepers": sleepers, "proud": truth["sleepers"]["top_above_floor"] if len(sleepers) else 0.0,
        "bulge": ["aside", "width", "height"] if uneven else ["aside"],
        "middle": np.array(truth["middle"])[:, 0],
    }  # fmt: skip


def seen_on_the_way(folder: Path, places: np.ndarray) -> np.ndarray:
    """Return whether a carrier on the true poses of a survey could see places on its surface, m `(p, 3)`."""
    mesh = PlyData.read(folder / "truth.ply")
    vertices = np.column_stack([mesh["vertex"][k] for k in "xyz"])
    origin = np.floor(vertices[0])
    scene = EmbreeScene(robust=True)
    faces = np.vstack(mesh["face"]["vertex_indices"]).astype(np.int32)
    TriangleMesh(scene, (vertices - origin).astype(np.float32), faces)
    poses = np.loadtxt(min(folder.glob("groundtruth*.tum")), usecols=(1, 2, 3))  # one rack: any of its LiDARs
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses, axis=0), axis=1))])
    at = path[cKDTree(poses).query(places)[1]]
    seen = np.zeros(len(places), bool)
    for ahead in _BESIDE:
        stand = poses[np.searchsorted(path, np.clip(at + ahead, 0.0, path[-1])).clip(0, len(path) - 1)]
        ray = places - stand
        far = np.linalg.norm(ray, axis=1)
        start = (stand - origin).astype(np.float32)
        reach = scene.run(start, (ray / far[:, None]).astype(np.float32), query="DISTANCE")
        seen |= reach > far - _CLEAR
    return seen


def spoil_poses(folder: Path, name: str, spoil: Spoil) -> Path:
    """Writes the true poses of a survey, spoilt, beside them; returns the new file."""
    rows = [line.split() for line in (folder / "groundtruth.tum").read_text().splitlines()]
    whole = np.array([int(row[0].split(".")[0]) for row in rows])
    table = np.array(rows, float)
    table[:, 0] = [int(row[0].split(".")[1]) * 1e-6 for row in rows]  # digits that float64 would lose beside the epoch
    table = spoil(table)
    path = folder / f"{name}.tum"
    seconds = whole + np.floor(table[:, 0]).astype(int)
    micro = np.round(1e6 * (table[:, 0] - np.floor(table[:, 0]))).astype(int).clip(0, 999_999)
    lines = [
        f"{s}.{u:06d} " + " ".join(f"{value:.9f}" for value in row[1:])
        for s, u, row in zip(seconds, micro, table, strict=True)
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def pitched(rows: Rows) -> Rows:
    """Return poses of a LiDAR whose mount is believed 3° off in pitch."""
    turned = Rotation.from_quat(rows[:, 4:]) * Rotation.from_euler("y", 3.0, degrees=True)
    return np.column_stack([rows[:, :4], turned.as_quat()])


def late(seconds: float) -> Spoil:
    """Return a maker of poses whose clock is ahead by some seconds."""
    return lambda rows: np.column_stack([rows[:, 0] + seconds, rows[:, 1:]])


def scalar_first(rows: Rows) -> Rows:
    """Return poses whose quaternions are written w x y z."""
    return rows[:, [0, 1, 2, 3, 7, 4, 5, 6]]
