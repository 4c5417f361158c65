"""Compares a reconstructed bore with the exact truth of a simulated survey; nothing is fitted or scaled first."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

SCHEMA = "subterra.truth/1"
_FINE = 0.01  # m between points where the nearest one is looked up


@dataclass(frozen=True)
class Truth:
    """True centreline and section sizes in the survey frame."""

    station: Float[np.ndarray, " n"]  # Stations, m
    position: Float[np.ndarray, "n 3"]  # Points of the centreline, m
    width: Float[np.ndarray, " n"]  # Largest inner width, m
    height: Float[np.ndarray, " n"]  # Floor to crown on the axis, m


@dataclass(frozen=True)
class Comparison:
    """Errors of a bore against the truth, station by station."""

    station: Float[np.ndarray, " k"]  # True station of each compared section, m
    lateral: Float[np.ndarray, " k"]  # Offset of the axis to the left, m
    vertical: Float[np.ndarray, " k"]  # Offset upwards, m
    width: Float[np.ndarray, " k"]  # Width error, m
    height: Float[np.ndarray, " k"]  # Height error, m
    length_error: float  # Reconstructed less true length, m

    def figures(self) -> dict[str, float]:
        """Returns the errors as single numbers, m."""
        squares = {"centreline": self.lateral**2 + self.vertical**2, "width": self.width**2, "height": self.height**2}
        rmse = {f"{name}_rmse": float(np.sqrt(np.mean(values))) for name, values in squares.items()}
        return {**rmse, "length_error": self.length_error}


def load_truth(path: Path) -> Truth:
    """Reads `truth.json`.

    Raises:
        ValueError: The file has another schema.
    """
    data = json.loads(path.read_text())
    if data.get("schema") != SCHEMA:
        raise ValueError(f"{path}: schema is {data.get('schema')}, not {SCHEMA}")
    return Truth(*(np.asarray(data[name], float) for name in ("station", "position", "width", "height")))


def centreline(scene: Path) -> tuple[np.ndarray, np.ndarray]:
    """Returns stations (m, `(n,)`) and positions (m, `(n, 3)`) of a scene's bore in the frame of its survey."""
    with np.load(scene / "bore.npz") as bore:
        origin = np.asarray(json.loads((scene / "manifest.json").read_text())["frame"]["origin"])
        return bore["station"], bore["position"] + origin


def compare(scene: Path, truth: Truth) -> Comparison:
    """Compares a scene's bore with the truth: each true section with the nearest point of the reconstruction.

    Args:
        scene: Folder with `bore.npz` and `manifest.json`.
        truth: Truth of the survey.
    """
    station, position = centreline(scene)
    with np.load(scene / "bore.npz") as bore:
        size = {name: CubicSpline(station, bore[name]) for name in ("width", "height")}
    curve = CubicSpline(station, position)
    fine = np.arange(0.0, station[-1], _FINE)
    at = fine[cKDTree(curve(fine)).query(truth.position)[1]]
    inside = (at > 0) & (at < fine[-1])
    at, offset = at[inside], (curve(at) - truth.position)[inside]
    tangent = CubicSpline(truth.station, truth.position)(truth.station[inside], 1)
    left = np.cross([0.0, 0.0, 1.0], tangent)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return Comparison(
        truth.station[inside],
        np.einsum("ij,ij->i", offset, left),
        offset[:, 2],
        size["width"](at) - truth.width[inside],
        size["height"](at) - truth.height[inside],
        float(station[-1] - (truth.station[-1] - truth.station[0])),
    )


REACH = 0.15  # m, largest distance between a feature and its match


def sleepers_of(scene: Path) -> Float[np.ndarray, "n 3"]:
    """Returns the middles of the sleepers in `scene.xml`, m."""
    geoms = re.findall(r'<geom[^>]*name="sleeper_[^>]*>', (scene / "scene.xml").read_text())
    places = [re.search(r'pos="([^"]*)"', geom) for geom in geoms]
    return np.array([place[1].split() for place in places if place], float).reshape(-1, 3)


def f1(hits: int, built: int, true: int) -> float:
    """Returns the harmonic mean of precision and recall; 1 where there is nothing and nothing was found."""
    return 2 * hits / (built + true) if built + true else 1.0


def one_to_one(built: Float[np.ndarray, "n d"], true: Float[np.ndarray, "m d"]) -> tuple[np.ndarray, np.ndarray]:
    """Matches features within `REACH`, each at most once, nearest pairs first; returns the indices of both."""
    if not len(built) or not len(true):
        return np.empty(0, int), np.empty(0, int)
    near = cKDTree(built).sparse_distance_matrix(cKDTree(true), REACH, output_type="coo_matrix")
    order = np.argsort(near.data, kind="stable")
    free_built, free_true, pairs = np.ones(len(built), bool), np.ones(len(true), bool), []
    for i, j in zip(near.row[order], near.col[order], strict=True):
        if free_built[i] and free_true[j]:
            free_built[i] = free_true[j] = False
            pairs.append((i, j))
    matched = np.array(pairs, int).reshape(-1, 2)
    return matched[:, 0], matched[:, 1]
