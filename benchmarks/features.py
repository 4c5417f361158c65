"""What a reconstruction found of the furniture of a bore, against the truth of a simulated survey."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

REACH = 0.15  # m between a feature and what it is taken for


def pocket_figures(scene: Path, survey: Path) -> dict[str, float]:
    """F1 of the pockets of `bore.npz` against the open ones of the truth, one to one within `REACH`, and their depth.

    Returns:
        `pocket_f1`, and `pocket_depth_error`: mean depth of the matched less the mean of theirs in truth, m.
    """
    with np.load(scene / "bore.npz") as data:
        bore = {name: data[name] for name in ("station", "position", "lateral", "up", "angle", "radius", "pocket")}
    pockets = [pocket for pocket in json.loads((survey / "truth.json").read_text())["pockets"] if pocket["open"]]
    true = np.array([pocket["position"] for pocket in pockets])
    found = _on_the_wall(bore) + _origin(scene)
    i, j = one_to_one(found, true)
    depth = np.array([pocket["depth"] for pocket in pockets])[j]
    error = float(np.mean(bore["pocket"]["depth"][i]) - depth.mean()) if len(i) else float("nan")
    return {"pocket_f1": f1(len(i), len(found), len(true)), "pocket_depth_error": error}


def sleeper_figures(scene: Path, survey: Path) -> dict[str, float]:
    """F1 of the sleepers in `scene.xml` against the truth, one to one within `REACH`, and the gauge that was seen.

    Returns:
        `sleeper_f1`, and `gauge_error`: gauge measured in the recording less the true one, m; NaN where none was seen.
    """
    import mujoco

    truth: dict[str, Any] = json.loads((survey / "truth.json").read_text())
    model = mujoco.MjModel.from_xml_path(str(scene / "scene.xml"))
    names = [model.geom(i).name for i in range(model.ngeom)]
    found = model.geom_pos[[i for i, name in enumerate(names) if name.startswith("sleeper_")], :2]
    true = np.asarray(truth["sleepers"]["position"], float).reshape(-1, 3)[:, :2]
    i, _ = one_to_one(found + _origin(scene)[:2], true)
    seen = json.loads((scene / "manifest.json").read_text())["track"].get("gauge_seen")
    return {
        "sleeper_f1": f1(len(i), len(found), len(true)),
        "gauge_error": float("nan") if seen is None else seen - truth["rails"]["gauge"],
    }


def f1(hits: int, found: int, true: int) -> float:
    """Harmonic mean of precision and recall; 1 where there is nothing and nothing was found."""
    return 2 * hits / (found + true) if found + true else 1.0


def one_to_one(found: Float[np.ndarray, "n d"], true: Float[np.ndarray, "m d"]) -> tuple[np.ndarray, np.ndarray]:
    """Pairs within `REACH`, each feature in one pair at most: the nearest pairs first."""
    if not len(found) or not len(true):
        return np.empty(0, int), np.empty(0, int)
    near = cKDTree(found).sparse_distance_matrix(cKDTree(true), REACH, output_type="coo_matrix")
    order = np.argsort(near.data, kind="stable")
    free_found, free_true, pairs = np.ones(len(found), bool), np.ones(len(true), bool), []
    for i, j in zip(near.row[order], near.col[order], strict=True):
        if free_found[i] and free_true[j]:
            free_found[i] = free_true[j] = False
            pairs.append((i, j))
    matched = np.array(pairs, int).reshape(-1, 2)
    return matched[:, 0], matched[:, 1]


def _origin(scene: Path) -> Float[np.ndarray, "3"]:
    return np.asarray(json.loads((scene / "manifest.json").read_text())["frame"]["origin"], float)


def _on_the_wall(bore: dict[str, np.ndarray]) -> Float[np.ndarray, "p 3"]:
    """Positions of the pockets' middles on the smooth wall, tunnel frame, m."""
    pocket, station = bore["pocket"], bore["station"]
    at = {
        name: np.stack([np.interp(pocket["station"], station, column) for column in bore[name].T], axis=1)
        for name in ("position", "lateral", "up")
    }
    row = np.rint(pocket["station"] / station[1]).astype(int).clip(0, len(station) - 1)
    radius = np.array(
        [
            np.interp(a, bore["angle"], bore["radius"][k], period=2 * np.pi)
            for a, k in zip(pocket["angle"], row, strict=True)
        ]
    )[:, None]
    angle = pocket["angle"][:, None]
    return at["position"] + radius * (np.cos(angle) * at["lateral"] + np.sin(angle) * at["up"])
