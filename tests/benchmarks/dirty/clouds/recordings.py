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
# deg, to both sides of the way and of the horizon, that each LiDAR sees; the carrier's sway is left out
_FIELD = {"avia": (35.2, 38.6), "vlp16": (180.0, 15.0), "os1": (180.0, 22.5)}
_ASIDE, _LAYBY, _DEEP = 0.05, 7.0, 0.05  # m: least width of a widening; shorter is a niche; how far behind the wall
_WALL_FROM = 0.5  # m above the floor
_MOST = 6000

Rows = np.ndarray  # (n, 8): t x y z qx qy qz qw
Spoil = Callable[[Rows], Rows]


def simulate_survey(folder: Path, seed: int, sensors: tuple[str, ...] = ("avia",)) -> None:
    """Simulates a survey, unless it is there already.

    Raises:
        BenchmarkError: The survey fails.
    """
    if all((folder / f"survey{SUFFIX[name]}.bag").is_file() for name in sensors):
        return
    words = ["--truth", "paper", "--length", f"{LENGTH:g}", "--seed", str(seed), "--out", str(folder)]
    words += ["--scan-every", "4", "--sensors", *sensors]
    done = subprocess.run([sys.executable, "-m", "scene.survey", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise BenchmarkError(f"{folder}: the survey failed: {done.stderr.strip().splitlines()[-1:]}")


def survey_truth(folder: Path, rng: np.random.Generator, sensor: str = "avia") -> dict[str, Any]:
    """Return the fields of the truth of a simulated survey: of the wall, what one of its LiDARs could see on the way.

    Niches are left out: a lay-by of 7 m belongs to the bore, and what is shorter is cut away, as the guide says.
    """
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
    inside &= ~_in_niche(truth, centre, near)
    chosen = rng.choice(np.flatnonzero(inside), min(4 * _MOST, int(inside.sum())), replace=False)
    chosen = chosen[seen_on_the_way(folder, centre[chosen], sensor)][:_MOST]
    return {
        "axis": axis, "wall": centre[chosen], "span": np.array([2.0, truth["length"] - 3.0]),
        "ends": np.array([0.0, truth["length"]]), "axis_above_floor": half, "width": np.array(truth["width"]),
        "height": np.array(truth["height"]), "track": tracks, "gauge": truth["rails"]["gauge"],
        "sleepers": sleepers, "proud": truth["sleepers"]["top_above_floor"] if len(sleepers) else 0.0,
        "bulge": ["aside", "width", "height"] if uneven else ["aside"],
        "middle": np.array(truth["middle"])[:, 0],
    }  # fmt: skip


def _in_niche(truth: dict[str, Any], places: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return which places lie in a widening to the left that is shorter than a lay-by; `near` is each one's row."""
    station, aside = np.array(truth["station"]), np.array(truth.get("aside", np.zeros(len(truth["station"]))))
    edges = np.diff(np.concatenate([[0], (aside > _ASIDE).astype(int), [0]]))
    short = np.zeros(len(station), bool)
    for first, end in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
        if station[end - 1] - station[first] < _LAYBY:
            short[max(first - 1, 0) : end + 1] = True
    axis, along = np.array(truth["position"]), np.array(truth["tangent"])
    left = np.cross([0.0, 0.0, 1.0], along[near])
    lateral = np.einsum("ij,ij->i", places - axis[near], left) / np.linalg.norm(left, axis=1)
    return short[near] & (lateral > 0.5 * (np.array(truth["width_smooth"]) - aside)[near] + _DEEP)


def seen_on_the_way(folder: Path, places: np.ndarray, sensor: str = "avia") -> np.ndarray:
    """Return whether a LiDAR on the true poses of a survey could see places on its surface, m `(p, 3)`."""
    mesh = PlyData.read(folder / "truth.ply")
    vertices = np.column_stack([mesh["vertex"][k] for k in "xyz"])
    origin = np.floor(vertices[0])
    scene = EmbreeScene(robust=True)
    faces = np.vstack(mesh["face"]["vertex_indices"]).astype(np.int32)
    TriangleMesh(scene, (vertices - origin).astype(np.float32), faces)
    poses = np.loadtxt(folder / f"groundtruth{SUFFIX[sensor]}.tum", usecols=(1, 2, 3))
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses, axis=0), axis=1))])
    at = path[cKDTree(poses).query(places)[1]]
    seen = np.zeros(len(places), bool)
    for ahead in _BESIDE:
        row = np.searchsorted(path, np.clip(at + ahead, 0.0, path[-1])).clip(0, len(path) - 1)
        way = poses[np.searchsorted(path, path[row] + 0.5).clip(1, len(path) - 1)] - poses[
            np.searchsorted(path, path[row] - 0.5).clip(0, len(path) - 2)]  # fmt: skip
        ray = places - poses[row]
        far = np.linalg.norm(ray, axis=1)
        start = (poses[row] - origin).astype(np.float32)
        reach = scene.run(start, (ray / far[:, None]).astype(np.float32), query="DISTANCE")
        seen |= (reach > far - _CLEAR) & _in_field(ray, way, sensor)
    return seen


def _in_field(ray: np.ndarray, way: np.ndarray, sensor: str) -> np.ndarray:
    """Return which rays lie in a LiDAR's field of view; it looks along the way, level, `(p, 3)` each."""
    turn = np.angle(np.exp(1j * (np.arctan2(ray[:, 1], ray[:, 0]) - np.arctan2(way[:, 1], way[:, 0]))))
    rise = np.arctan2(ray[:, 2], np.hypot(ray[:, 0], ray[:, 1]))
    across, upright = np.radians(_FIELD[sensor])
    return (np.abs(turn) <= across) & (np.abs(rise) <= upright)


def spoil_poses(folder: Path, name: str, spoil: Spoil, sensor: str = "avia") -> Path:
    """Writes the true poses of a survey's LiDAR, spoilt, beside them; returns the new file."""
    rows = [line.split() for line in (folder / f"groundtruth{SUFFIX[sensor]}.tum").read_text().splitlines()]
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


def _turned(rows: Rows, axis: str, angle: float) -> Rows:
    turned = Rotation.from_quat(rows[:, 4:]) * Rotation.from_euler(axis, angle, degrees=True)
    return np.column_stack([rows[:, :4], turned.as_quat()])


def pitched(rows: Rows) -> Rows:
    """Return poses of a LiDAR whose mount is believed 3° off in pitch."""
    return _turned(rows, "y", 3.0)


def rolled(rows: Rows) -> Rows:
    """Return poses of a LiDAR whose mount is believed 2° off in roll."""
    return _turned(rows, "x", 2.0)


def late(seconds: float) -> Spoil:
    """Return a maker of poses whose clock is ahead by some seconds."""
    return lambda rows: np.column_stack([rows[:, 0] + seconds, rows[:, 1:]])


def scalar_first(rows: Rows) -> Rows:
    """Return poses whose quaternions are written w x y z."""
    return rows[:, [0, 1, 2, 3, 7, 4, 5, 6]]
