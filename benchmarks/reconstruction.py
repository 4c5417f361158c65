"""Accuracy of reconstructions on simulated surveys of seeds that the builder was not developed on.

`python -m benchmarks.reconstruction --seeds 201 202 --out out/reconstruction`
"""

import json
import math
import re
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast, get_args

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from benchmarks.command import run_main, run_module
from benchmarks.fidelity.candidate import load_candidate
from benchmarks.fidelity.derive.surface import Nearest, visible_mesh
from benchmarks.fidelity.references import HoldConfig, load_hold
from benchmarks.records import Record, measured, write_records
from benchmarks.truth import compare, load_truth
from scene.survey.config import SurveyConfig, TruthName, check_survey
from subterra_jax.host.files import require_folder


@dataclass(frozen=True)
class ReconstructionConfig:
    """Simulates surveys, builds scenes and compares them with the truth.

    The builder reads the Avia; the OS1 on the same rack is held out.
    """

    seeds: tuple[int, ...] = (201, 202)  # Seeds for the surveys.
    length: float = 60.0  # Length of each bore, m.
    truth: str = "paper"  # Kind of bore; see `python -m scene.survey --help`.
    # `given`: true poses; `control`: odometry, IMU and prism.
    poses: tuple[Literal["given", "control"], ...] = ("given", "control")
    out: Path = Path("out/reconstruction")  # Output folder; surveys in it are not simulated again.


class Figure(NamedTuple):
    """Name, unit and record of a figure, and its limits with true poses and with control, in its unit."""

    record: str
    unit: str
    scale: float
    given: float
    control: float
    at_least: bool = False

    def shown(self, value: float) -> float:
        """Returns a value in the figure's unit; signed errors count by their size."""
        return self.scale * abs(value)

    def met(self, value: float, poses: str) -> bool:
        """Returns whether a value keeps to its limit; NaN does not."""
        limit = self.given if poses == "given" else self.control
        return self.shown(value) >= limit if self.at_least else self.shown(value) <= limit


FIGURES = {
    "length_error": Figure("length", "%", 1.0, 0.1, 0.2),
    "lateral_rmse": Figure("centreline", "cm", 100.0, 2.0, 5.0),
    "width_rmse": Figure("width", "cm", 100.0, 2.0, 4.0),
    "height_rmse": Figure("height", "cm", 100.0, 2.0, 4.0),
    "hold_mean": Figure("held-out", "cm", 100.0, 2.46, 3.0),
    "hold_within_10cm": Figure("within-10-cm", "%", 100.0, 97.5, 96.0, at_least=True),
    "pocket_f1": Figure("pocket-f1", "", 1.0, 0.90, 0.80, at_least=True),
    "pocket_depth_error": Figure("pocket-depth", "cm", 100.0, 1.5, 2.0),
    "sleeper_f1": Figure("sleeper-f1", "", 1.0, 0.97, 0.95, at_least=True),
    "gauge_error": Figure("gauge", "mm", 1000.0, 3.0, 5.0),
    "seconds": Figure("time", "min", 1.0 / 60.0, 5.0, 15.0),
    "memory": Figure("memory", "GiB", 1.0, 4.0, 4.0),
}


def simulate(config: ReconstructionConfig, seed: int) -> Path:
    """Simulates the survey of one seed with Avia and OS1; returns its folder."""
    folder = config.out / f"survey-{config.truth}-{config.length:g}-{seed}"
    if not (folder / "truth.json").exists():
        words = ["--truth", config.truth, "--length", config.length, "--seed", seed, "--out", folder]
        _run("scene.survey", *words, "--sensors", "avia", "os1", "--scan-every", 20)
    return folder


def build(survey: Path, out: Path, poses: str) -> dict[str, float]:
    """Builds the scene as a user would; returns wall-clock time, s, and peak memory, GiB."""
    given = ("--trajectory", survey / "groundtruth.tum")
    control = ("--control", survey / "prism.tum", "--calibration", "geode-gamma")
    started = time.monotonic()
    words = (*(given if poses == "given" else control), "--provenance", "simulated", "--out", out, "--fresh")
    memory = _run("scene.build", survey / "survey.bag", *words)
    return {"seconds": time.monotonic() - started, "memory": memory}


def figures(scene: Path, survey: Path) -> dict[str, float]:
    """Returns all figures of one scene but those of `build`; nothing is aligned, fitted or scaled first."""
    truth = load_truth(survey / "truth.json")
    errors = compare(scene, truth)
    candidate = load_candidate(scene)
    trajectory = survey / "groundtruth_os1.tum"
    hold = load_hold(survey / "survey_os1.bag", trajectory, candidate.origin, HoldConfig(beams_per_scan=2000))
    distance, _, _ = Nearest(visible_mesh(candidate)).query(hold.points)
    return {
        "length_error": 100.0 * errors.length_error / (truth.station[-1] - truth.station[0]),
        "lateral_rmse": float(np.sqrt(np.mean(errors.lateral**2))),
        "width_rmse": float(np.sqrt(np.mean(errors.width**2))),
        "height_rmse": float(np.sqrt(np.mean(errors.height**2))),
        "hold_mean": float(distance.mean()),
        "hold_within_10cm": float(np.mean(distance < 0.10)),
        **pocket_figures(scene, survey),
        **sleeper_figures(scene, survey),
    }


def measure(config: ReconstructionConfig) -> list[dict[str, Any]]:
    """Measures every seed with every source of poses; returns one row for each."""
    rows = []
    for seed in config.seeds:
        survey = simulate(config, seed)
        for poses in config.poses:
            scene = config.out / f"scene-{config.truth}-{config.length:g}-{seed}-{poses}"
            cost = build(survey, scene, poses)
            rows.append({"seed": seed, "poses": poses, **figures(scene, survey), **cost})
    return rows


def show(rows: list[dict[str, Any]], console: Console) -> None:
    """Prints the figures beside their limits; missed ones are marked."""
    heads = ("figure", *(f"seed {row['seed']}, {row['poses']}" for row in rows), "limit: given", "control")
    table = Table(*heads, title="simulated surveys, held out from development")
    for name, figure in FIGURES.items():
        cells = [
            f"{figure.shown(row[name]):.3g}" + ("" if figure.met(row[name], row["poses"]) else " [red]missed[/red]")
            for row in rows
        ]
        sign = "≥" if figure.at_least else "≤"
        limits = (f"{sign} {limit:g}" for limit in (figure.given, figure.control))
        table.add_row(f"{name} {figure.unit}".strip(), *cells, *limits)
    console.print(table)


def _run(module: str, *words: object) -> float:
    """Runs a command and returns its peak memory, GiB; one that fails ends this one too."""
    ran = run_module(module, *words)
    if ran.status:
        sys.exit(ran.status)
    return ran.memory


def check(config: ReconstructionConfig) -> None:
    """Refuses settings that cannot be simulated or written.

    Raises:
        ValueError: No seed or source of poses is given, or a number is out of range.
        SubterraError: The folder cannot be written.
    """
    for name in ("seeds", "poses"):
        if not getattr(config, name):
            raise ValueError(f"{name} must name at least one")
    if config.truth not in get_args(TruthName):
        raise ValueError(f"no bore {config.truth!r}; there are {', '.join(get_args(TruthName))}")
    for seed in config.seeds:
        check_survey(SurveyConfig(config.out, truth=cast(TruthName, config.truth), length=config.length, seed=seed))
    require_folder(config.out)


def run(config: ReconstructionConfig) -> None:
    """Measures, prints, writes."""
    check(config)
    config.out.mkdir(parents=True, exist_ok=True)
    rows = measure(config)
    show(rows, Console())
    facts = {"config": asdict(config) | {"out": str(config.out)}, "provenance": "simulated", "rows": rows}
    name = f"figures-{config.truth}-{config.length:g}.json"
    (config.out / name).write_text(json.dumps(facts, indent=1) + "\n")
    write_records(config.out / "records.json", records_of(config, rows))


def records_of(config: ReconstructionConfig, rows: list[dict[str, Any]]) -> list[Record]:
    """Returns the figures of the first seed as records."""
    command = (
        f"benchmarks.reconstruction --seeds {config.seeds[0]} --length {config.length:g} --truth {config.truth} "
        "--out out/reconstruction"
    )
    further: dict[str, Any] = {"split": f"simulated survey of {config.length:g} m", "seed": config.seeds[0]}
    return [
        measured(f"reconstruction/{row['poses']}/{figure.record}", round(figure.shown(row[name]), 3), figure.unit,
                 command, **further)
        for row in rows
        if row["seed"] == config.seeds[0]
        for name, figure in FIGURES.items()
        if not math.isnan(row[name])
    ]  # fmt: skip


REACH = 0.15  # m, largest distance between a feature and its match


def pocket_figures(scene: Path, survey: Path) -> dict[str, float]:
    """Compares the pockets of `bore.npz` with the open ones of the truth, matched one to one within `REACH`.

    Returns:
        `pocket_f1`, and `pocket_depth_error`: mean depth of the matched pockets less their true mean depth, m.
    """
    with np.load(scene / "bore.npz") as data:
        bore = {name: data[name] for name in ("station", "position", "lateral", "up", "angle", "radius", "pocket")}
    pockets = [pocket for pocket in json.loads((survey / "truth.json").read_text())["pockets"] if pocket["open"]]
    true = np.array([pocket["position"] for pocket in pockets])
    built = _pocket_positions(bore) + _origin(scene)
    i, j = one_to_one(built, true)
    depth = np.array([pocket["depth"] for pocket in pockets])[j]
    error = float(np.mean(bore["pocket"]["depth"][i]) - depth.mean()) if len(i) else float("nan")
    return {"pocket_f1": f1(len(i), len(built), len(true)), "pocket_depth_error": error}


def sleeper_figures(scene: Path, survey: Path) -> dict[str, float]:
    """Compares the sleepers of `scene.xml` and the measured gauge with the truth.

    Returns:
        `sleeper_f1`, and `gauge_error`: measured less true gauge, m; NaN where none was measured.
    """
    truth: dict[str, Any] = json.loads((survey / "truth.json").read_text())
    built = sleepers_of(scene)
    true = np.asarray(truth["sleepers"]["position"], float).reshape(-1, 3)
    i, _ = one_to_one(built[:, :2] + _origin(scene)[:2], true[:, :2])
    gauge = json.loads((scene / "manifest.json").read_text())["track"].get("gauge_seen")
    return {
        "sleeper_f1": f1(len(i), len(built), len(true)),
        "gauge_error": float("nan") if gauge is None else gauge - truth["rails"]["gauge"],
    }


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


def _origin(scene: Path) -> Float[np.ndarray, "3"]:
    return np.asarray(json.loads((scene / "manifest.json").read_text())["frame"]["origin"], float)


def _pocket_positions(bore: dict[str, np.ndarray]) -> Float[np.ndarray, "p 3"]:
    """Returns the middles of the pockets on the smooth wall, tunnel frame, m."""
    pocket, station = bore["pocket"], bore["station"]
    position, lateral, up = (
        np.stack([np.interp(pocket["station"], station, column) for column in bore[name].T], axis=1)
        for name in ("position", "lateral", "up")
    )
    row = np.rint(pocket["station"] / station[1]).astype(int).clip(0, len(station) - 1)
    radius = [np.interp(a, bore["angle"], bore["radius"][k], period=2 * np.pi)
              for a, k in zip(pocket["angle"], row, strict=True)]  # fmt: skip
    angle = pocket["angle"][:, None]
    return position + np.array(radius).reshape(-1, 1) * (np.cos(angle) * lateral + np.sin(angle) * up)


if __name__ == "__main__":
    sys.exit(run_main("reconstruction", ReconstructionConfig, run, description=__doc__))
