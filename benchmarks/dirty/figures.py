"""Figures of a built scene against truth, read off its meshes; nothing is aligned, fitted or scaled."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.ndimage import median_filter

from benchmarks.dirty.truth import Truth
from benchmarks.fidelity.derive.surface import Caster, Nearest
from benchmarks.reconstruction import f1, one_to_one, sleepers_of

NEAR = 0.10  # m within which a wall point counts as met
_STEP = 0.5  # m between the stations at which sizes are read
_LEVELS = np.arange(-0.42, 0.43, 0.06)  # heights of chords about the middle, as shares of the height
_SMOOTH = 3  # stations of the running median of an error, so that one chord into a crack decides nothing
FLOOR_LINES = (-0.3, 0.0, 0.3)  # m beside the axis at which the floor is read; the lowest, between sleepers, counts


@dataclass(frozen=True)
class Frames:
    """Places on the true axis."""

    station: Float[np.ndarray, " k"]  # m
    position: Float[np.ndarray, "k 3"]  # m
    tangent: Float[np.ndarray, "k 3"]  # Unit vectors
    lateral: Float[np.ndarray, "k 3"]  # Unit vectors to the left, horizontal
    row: Float[np.ndarray, " k"]  # Place in the arrays of the truth


def true_frames(truth: Truth, step: float = _STEP) -> Frames:
    """Return places `step` m apart inside the judged span of the true axis."""
    station, known = np.arange(truth.span[0] + step / 2, truth.span[1], step), truth.station

    def at(columns: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
        return np.stack([np.interp(station, known, column) for column in columns.T], axis=1)

    tangent = _unit(at(np.gradient(truth.axis, known, axis=0)))
    lateral = _unit(np.cross([0.0, 0.0, 1.0], tangent))
    return Frames(station, at(truth.axis), tangent, lateral, np.interp(station, known, np.arange(len(known))))


def _unit(vectors: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def judge_scene(scene: Path, truth: Truth) -> dict[str, Any]:
    """Return the figures of a scene folder: walls, sizes, ends and track, m; NaN where one is not defined."""
    manifest = json.loads((scene / "manifest.json").read_text())
    origin = np.asarray(manifest["frame"]["origin"], float)
    lining, smooth = (_load(scene / "meshes" / name, origin) for name in ("lining.ply", "lining_smooth.ply"))
    figures = {**wall_figures(lining, truth), **size_figures(smooth, truth), **end_figures(scene, origin, truth)}
    return {**figures, **track_figures(scene, manifest, origin, truth), **claimed(manifest)}


def _load(path: Path, origin: np.ndarray) -> trimesh.Trimesh:
    mesh = trimesh.load_mesh(path, process=False)
    return trimesh.Trimesh(np.asarray(mesh.vertices, float) + origin, mesh.faces, process=False)


def wall_figures(lining: trimesh.Trimesh, truth: Truth) -> dict[str, float]:
    """Return mean, share within `NEAR` and 99th percentile of the distance of the true wall to the mesh, m."""
    if not len(truth.wall):
        return {}
    origin = np.floor(truth.wall[0])  # coordinates of millions of metres would cost digits
    moved = trimesh.Trimesh(lining.vertices - origin, lining.faces, process=False)
    distance = Nearest(moved).query(truth.wall - origin)[0]
    return {
        "wall_mean": float(distance.mean()),
        "wall_near": float(np.mean(distance < NEAR)),
        "wall_p99": float(np.quantile(distance, 0.99)),
    }


def size_figures(smooth: trimesh.Trimesh, truth: Truth) -> dict[str, float]:
    """Return median and worst errors of width, height, floor and middle along the judged span, m.

    The worst is the largest of a running median over 1.5 m. A station at which a ray from the axis leaves the mesh has
    no error, but lowers `seen`. The width is that of the widest chord, or the median of those in the truth's `band`,
    where its own is: the widest chord between rough walls is wider than they stand apart.
    """
    frames = true_frames(truth)
    caster = Caster(smooth)
    rows = np.arange(len(truth.axis))
    above, height, width, middle = (
        np.interp(frames.row, rows, np.broadcast_to(values, len(rows)))
        for values in (truth.axis_above_floor, truth.height, truth.width, truth.middle)
    )
    up = np.array([0.0, 0.0, 1.0])
    drops = [_reach(caster, frames.position + y * frames.lateral, -up) for y in FLOOR_LINES]
    rise = _reach(caster, frames.position, up)
    drop = np.max(drops, axis=0)
    left, right, level_above = np.full((3, len(_LEVELS), len(frames.station)), np.nan)
    span = np.where(np.isfinite(height), height, 2.0 * above)
    for k, level in enumerate(_LEVELS):
        level_above[k] = level * span + 0.5 * span - above
        start = frames.position + level_above[k][:, None] * up
        left[k], right[k] = _reach(caster, start, frames.lateral), _reach(caster, start, -frames.lateral)
    left, right = _across(left, right, level_above, truth.band)
    errors = {
        "width": left + right - width,
        "height": drop + rise - height,
        "floor": above - drop,  # positive where the built floor lies too high
        "aside": 0.5 * (left - right) - middle,
    }
    figures = {"seen": float(np.mean(np.isfinite(drop + rise)))}
    for name, error in errors.items():
        figures |= _summed(name, error, frames.station)
    return figures


def _across(
    left: np.ndarray, right: np.ndarray, height: np.ndarray, band: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances to the left and right wall by which a section is judged, m.

    Args:
        left: Distances to the left wall on each level, m `(levels, k)`; NaN where there is none.
        right: Those to the right.
        height: Heights of the levels about the axis, m.
        band: See `Truth`.
    """
    if np.isfinite(band).all():
        inside = (height >= band[0]) & (height <= band[1]) & np.isfinite(left + right)
        masked = (np.ma.masked_array(side, ~inside) for side in (left, right))
        middle_left, middle_right = (np.ma.median(side, axis=0).filled(np.nan) for side in masked)
        return middle_left, middle_right
    chord = np.where(np.isfinite(left + right), left + right, -np.inf)
    widest, at = np.argmax(chord, axis=0), np.arange(chord.shape[1])
    return left[widest, at], right[widest, at]


def _reach(caster: Caster, start: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Distance to the first surface, m; NaN where there is none."""
    reach = caster.first(start, np.broadcast_to(heading, start.shape).copy())[0]
    return np.where(np.isfinite(reach), reach, np.nan)


def _summed(name: str, error: np.ndarray, station: np.ndarray) -> dict[str, float]:
    known = np.isfinite(error)
    if not known.any():
        return {name: float("nan"), f"{name}_worst": float("nan"), f"{name}_worst_at": float("nan")}
    smooth = median_filter(error[known], _SMOOTH, mode="nearest")
    worst = int(np.argmax(np.abs(smooth)))
    at = float(station[known][worst])
    return {name: float(np.median(error[known])), f"{name}_worst": float(smooth[worst]), f"{name}_worst_at": at}


def end_figures(scene: Path, origin: np.ndarray, truth: Truth) -> dict[str, float]:
    """Return the true stations at which the built bore begins and ends, and how far it goes beyond the lining, m."""
    with np.load(scene / "bore.npz") as bore:
        ends = bore["position"][[0, -1]] + origin
    first, last = (project_station(point, truth) for point in ends)
    station = np.sort([first, last])
    beyond = [truth.ends[0] - station[0], station[1] - truth.ends[1]]
    worst = float(np.nanmax(beyond)) if np.isfinite(beyond).any() else float("nan")
    covered = np.clip(station, *truth.span)
    share = float((covered[1] - covered[0]) / (truth.span[1] - truth.span[0]))
    ends_at = {"from": float(station[0]), "to": float(station[1]), "reversed": bool(first > last)}
    return {**ends_at, "beyond": worst, "covered": share}


def project_station(point: Float[np.ndarray, "3"], truth: Truth) -> float:
    """Return the station of a point on the true axis, which runs on straight beyond its ends, m."""
    row = int(np.argmin(np.linalg.norm(truth.axis - point, axis=1)))
    near = np.clip([row - 1, row + 1], 0, len(truth.axis) - 1)
    along = truth.axis[near[1]] - truth.axis[near[0]]
    along /= np.linalg.norm(along)
    return float(truth.station[row] + (point - truth.axis[row]) @ along)


def track_figures(scene: Path, manifest: dict[str, Any], origin: np.ndarray, truth: Truth) -> dict[str, Any]:
    """Return what track was built, and how well it meets a true one."""
    built = sleepers_of(scene)
    facts = manifest.get("track", {})
    figures = {
        "sleepers": len(built),
        "sleepers_seen": facts.get("sleepers_seen"),
        "gauge_seen": facts.get("gauge_seen"),
        "track_provenance": manifest.get("provenance", {}).get("sleepers", "none"),
    }
    if len(truth.sleepers):
        met = one_to_one(built[:, :2] + origin[:2], truth.sleepers[:, :2])[0]
        figures["sleeper_f1"] = f1(len(met), len(built), len(truth.sleepers))
    return figures


def claimed(manifest: dict[str, Any]) -> dict[str, Any]:
    """Return what the scene says of itself: cuts, share explained, rings and pockets measured or by standard."""
    provenance, count = manifest.get("provenance", {}), manifest.get("count", {})
    found: dict[str, Any] = {
        "removed": [f"{cut['start']:.0f} to {cut['end']:.0f} m: {cut['cause']}" for cut in manifest.get("removed", [])],
        "explained": manifest.get("judgement", {}).get("share", {}).get("explained"),
    }
    for name in ("rings", "pockets"):
        told = str(provenance.get(name, "none"))
        number = 0 if told.startswith("none") else int(count.get(name, 0))
        found[f"{name}_by_standard" if "by standard" in told else f"{name}_measured"] = number
    return found
