"""Builds of clouds as scanners leave them, judged against truth: built right, warned of, refused, or wrong unsaid.

Example: python -m benchmarks.dirty ../shared/data/dirty_clouds --out out/dirty
"""

import json
import math
import shutil
import sys
import time
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import trimesh
import tyro
from jaxtyping import Float
from rich.console import Console
from scipy.ndimage import median_filter

from benchmarks.command import BenchmarkError, run_main, run_module
from benchmarks.fidelity.derive.surface import Caster, Nearest
from benchmarks.records import Record, measured, write_records
from benchmarks.results import markdown_table, write_file
from benchmarks.truth import f1, one_to_one, sleepers_of
from scene.errors import Code
from subterra_jax.host.files import require_folder

_ENDING = "_truth.npz"
_INPUTS = (".laz", ".las", ".ply", ".pcd", ".e57", ".xyz", ".csv", ".npz", ".bag", "")
_ALONG = ("axis_above_floor", "width", "height")  # at each point of the axis, or one for all
_progress = Console(stderr=True, highlight=False)


@dataclass(frozen=True)
class Truth:
    """Truth of one cloud, `NAME_truth.npz`: `axis`, `wall` and `span`; the others where they are known."""

    axis: Float[np.ndarray, "n 3"]  # Points of the true axis by growing station, m
    wall: Float[np.ndarray, "w 3"]  # Points of the lining that the scanner saw, m
    span: tuple[float, float]  # Stations that are judged, m
    axis_above_floor: Float[np.ndarray, " n"]  # m; NaN where it is not known
    width: Float[np.ndarray, " n"]  # Largest inner width, m; NaN where it is not defined
    height: Float[np.ndarray, " n"]  # Floor to crown on the axis, m; NaN where it is not defined
    sleepers: Float[np.ndarray, "k 3"] | None = None  # Middles of their tops, m; None where they are not known

    @property
    def station(self) -> Float[np.ndarray, " n"]:
        """Station of each point of the axis, m."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.axis, axis=0), axis=1))])


class Case(NamedTuple):
    """One cloud with its truth."""

    name: str
    source: Path  # Input of the builder
    truth: Path


def find_cases(folder: Path, only: tuple[str, ...] = ()) -> list[Case]:
    """Return the cases of a folder by name.

    Args:
        folder: Folder with `NAME.laz`, or another input called `NAME`, beside each `NAME_truth.npz`.
        only: Beginnings of the names needed; all where it is empty.

    Raises:
        BenchmarkError: The folder holds no case of such a name, or a truth has no input beside it.
    """
    cases = []
    for truth in sorted(folder.glob(f"*{_ENDING}")):
        name = truth.name.removesuffix(_ENDING)
        if only and not name.startswith(only):
            continue
        inputs = [path for path in (folder / f"{name}{ending}" for ending in _INPUTS) if path.exists()]
        if not inputs:
            raise BenchmarkError(f"{truth}: there is no cloud {name} beside it")
        cases.append(Case(name, inputs[0], truth))
    if not cases:
        raise BenchmarkError(f"{folder}: no NAME{_ENDING}" + (f" that begins with {' or '.join(only)}" if only else ""))
    return cases


def load_truth(path: Path) -> Truth:
    """Reads a truth.

    Raises:
        BenchmarkError: The file is none.
    """
    try:
        with np.load(path) as data:
            values: dict[str, Any] = {name: data[name] for name in data}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise BenchmarkError(f"{path}: not a truth file ({error})") from error
    if missing := {"axis", "wall", "span"} - set(values):
        raise BenchmarkError(f"{path}: has no {' and no '.join(sorted(missing))}")
    count = len(values["axis"])
    along = {name: np.broadcast_to(np.asarray(values.get(name, np.nan), float), count) for name in _ALONG}
    span = float(values["span"][0]), float(values["span"][1])
    return Truth(values["axis"], values["wall"], span, sleepers=values.get("sleepers"), **along)


NEAR = 0.10  # m within which a wall point counts as met
_STEP = 0.5  # m between the stations at which sizes are read
_LEVELS = np.arange(-0.42, 0.43, 0.06)  # heights of chords about the middle, as fractions of the height
_SMOOTH = 3  # stations of the running median of an error, so that one chord into a crack decides nothing
_FLOOR_LINES = (-0.3, 0.0, 0.3)  # m beside the axis at which the floor is read; the lowest, between sleepers, counts


def judge_scene(scene: Path, truth: Truth) -> dict[str, Any]:
    """Return the figures of a scene folder, read off its meshes: walls, sizes, ends and sleepers, m.

    Nothing is aligned, fitted or scaled. NaN where a figure is not defined.
    """
    manifest = json.loads((scene / "manifest.json").read_text())
    origin = np.asarray(manifest["frame"]["origin"], float)
    lining, smooth = (_load(scene / "meshes" / name, origin) for name in ("lining.ply", "lining_smooth.ply"))
    found = {**wall_figures(lining, truth), **size_figures(smooth, truth), **end_figures(scene, origin, truth)}
    built = sleepers_of(scene)
    found |= {"sleepers": len(built), "sleepers_seen": manifest.get("track", {}).get("sleepers_seen")}
    if truth.sleepers is not None:
        met = one_to_one(built[:, :2] + origin[:2], truth.sleepers[:, :2])[0]
        found["sleeper_f1"] = f1(len(met), len(built), len(truth.sleepers))
    return found


def _load(path: Path, origin: np.ndarray) -> trimesh.Trimesh:
    mesh = trimesh.load_mesh(path, process=False)
    return trimesh.Trimesh(np.asarray(mesh.vertices, float) + origin, mesh.faces, process=False)


def wall_figures(lining: trimesh.Trimesh, truth: Truth) -> dict[str, float]:
    """Return the mean distance of the true wall from the mesh, m, and the fraction within `NEAR`."""
    if not len(truth.wall):
        return {}
    origin = np.floor(truth.wall[0])  # coordinates of millions of metres would cost digits
    moved = trimesh.Trimesh(lining.vertices - origin, lining.faces, process=False)
    distance = Nearest(moved).query(truth.wall - origin)[0]
    return {"wall_mean": float(distance.mean()), "wall_near": float(np.mean(distance < NEAR))}


def size_figures(smooth: trimesh.Trimesh, truth: Truth) -> dict[str, float]:
    """Return median and worst errors of width, height, floor and middle along the judged span, m.

    The worst is the largest of a running median over 1.5 m. A station at which a ray from the axis leaves the mesh has
    no error. The width is that of the widest chord.
    """
    known = truth.station
    station = np.arange(truth.span[0] + _STEP / 2, truth.span[1], _STEP)
    position, tangent = (
        np.stack([np.interp(station, known, column) for column in columns.T], axis=1)
        for columns in (truth.axis, np.gradient(truth.axis, known, axis=0))
    )
    up = np.array([0.0, 0.0, 1.0])
    lateral = np.cross(up, tangent)
    lateral /= np.linalg.norm(lateral, axis=1, keepdims=True)
    above, height, width = (np.interp(station, known, getattr(truth, name)) for name in ("axis_above_floor", "height",
                                                                                         "width"))  # fmt: skip
    caster = Caster(smooth)

    def reach(start: np.ndarray, heading: np.ndarray) -> np.ndarray:
        distance = caster.first(start, np.broadcast_to(heading, start.shape).copy())[0]
        return np.where(np.isfinite(distance), distance, np.nan)

    rise = reach(position, up)
    drop = np.max([reach(position + y * lateral, -up) for y in _FLOOR_LINES], axis=0)
    span = np.where(np.isfinite(height), height, 2.0 * above)
    sides = []
    for level in _LEVELS:
        start = position + (level * span + 0.5 * span - above)[:, None] * up
        sides.append((reach(start, lateral), reach(start, -lateral)))
    left, right = np.array(sides).transpose(1, 0, 2)
    chord = np.where(np.isfinite(left + right), left + right, -np.inf)
    widest, at = np.argmax(chord, axis=0), np.arange(len(station))
    left, right = left[widest, at], right[widest, at]
    errors = {
        "width": left + right - width,
        "height": drop + rise - height,
        "floor": above - drop,  # positive where the built floor lies too high
        "aside": 0.5 * (left - right),
    }
    return {key: value for name, error in errors.items() for key, value in _summed(name, error, station).items()}


def _summed(name: str, error: np.ndarray, station: np.ndarray) -> dict[str, float]:
    known = np.isfinite(error)
    if not known.any():
        return {name: math.nan, f"{name}_worst": math.nan, f"{name}_worst_at": math.nan}
    smooth = median_filter(error[known], _SMOOTH, mode="nearest")
    worst = int(np.argmax(np.abs(smooth)))
    at = float(station[known][worst])
    return {name: float(np.median(error[known])), f"{name}_worst": float(smooth[worst]), f"{name}_worst_at": at}


def end_figures(scene: Path, origin: np.ndarray, truth: Truth) -> dict[str, float]:
    """Return the true stations at which the built bore begins and ends, and the fraction of the span that it covers."""
    with np.load(scene / "bore.npz") as bore:
        first, last = (project_station(point + origin, truth) for point in bore["position"][[0, -1]])
    station = np.sort([first, last])
    covered = np.clip(station, *truth.span)
    fraction = float((covered[1] - covered[0]) / (truth.span[1] - truth.span[0]))
    return {"from": float(station[0]), "to": float(station[1]), "reversed": bool(first > last), "covered": fraction}


def project_station(point: Float[np.ndarray, "3"], truth: Truth) -> float:
    """Return the station of a point on the true axis, which runs on straight beyond its ends, m."""
    row = int(np.argmin(np.linalg.norm(truth.axis - point, axis=1)))
    near = np.clip([row - 1, row + 1], 0, len(truth.axis) - 1)
    along = truth.axis[near[1]] - truth.axis[near[0]]
    along /= np.linalg.norm(along)
    return float(truth.station[row] + (point - truth.axis[row]) @ along)


CLOSE = 0.03  # m: sizes and the mean distance of walls may be off by this
NEAR_FRACTION = 0.97  # of the wall points must be met within 10 cm
COVERED = 0.97  # of the judged span must be built
SLEEPER_F1 = 0.9
_SLACK = 2.0  # m between the stretch of a warning and a fault
RIGHT, WARNED, VAGUE, SILENT = "right", "warned", "vague", "SILENT"
REFUSED, FAILED = "refused", "FAILED"  # FAILED: not by a sentence

_FRAME = (Code.AXES, Code.LYING, Code.SIZE, Code.CALIBRATION)  # what is wrong with the whole cloud
_BLURRED = (Code.POSES, Code.CLOCK, Code.DOUBLED, Code.ROUNDED)
_SHAPE = (*_FRAME, *_BLURRED, Code.DENT, Code.UNSEEN, Code.PLACE, Code.UNEXPLAINED, Code.CUT)
# The codes of the warnings that speak of each kind of fault.
TOLD_BY: dict[str, tuple[Code, ...]] = {
    **dict.fromkeys(("walls", "width", "height", "floor", "aside"), _SHAPE),
    "too short": (*_FRAME, Code.LENGTH, Code.BEYOND, Code.CUT, Code.CUT_SHORT),
    "sleepers": (*_FRAME, *_BLURRED, Code.SLEEPERS, Code.RAILS),
}


@dataclass(frozen=True)
class Fault:
    """A fault of a built scene beyond the tolerances."""

    kind: str  # A key of `TOLD_BY`
    text: str  # It in a few words
    place: float = math.nan  # True station, m; NaN where it has none


def list_faults(row: dict[str, Any]) -> list[Fault]:
    """Returns the faults of a built scene from its figures, as `judge_scene` returns them."""
    faults = []
    if row.get("wall_mean", 0.0) > CLOSE:
        faults.append(Fault("walls", f"walls {100 * row['wall_mean']:.1f} cm in the mean"))
    if row.get("wall_near", 1.0) < NEAR_FRACTION:
        faults.append(Fault("walls", f"{100 * row['wall_near']:.1f} % within 10 cm"))
    for name in ("width", "height", "floor", "aside"):
        if abs(row[f"{name}_worst"]) > CLOSE:
            place = row[f"{name}_worst_at"]
            faults.append(Fault(name, f"{name} {100 * row[f'{name}_worst']:+.0f} cm at {place:.0f} m", place))
    if row["covered"] < COVERED:
        faults.append(Fault("too short", f"only {100 * row['covered']:.0f} % of the span built"))
    if row.get("sleeper_f1", 1.0) < SLEEPER_F1:
        faults.append(Fault("sleepers", f"sleeper F1 {row['sleeper_f1']:.2f}"))
    return faults


def judge_build(row: dict[str, Any], faults: Iterable[Fault]) -> str:
    """Returns the verdict on a build; warnings of other things than its faults leave it vague.

    Args:
        row: Its `status` and `warnings`; of a built scene `from`, `to` and `reversed` too.
        faults: Its faults.
    """
    if row["status"]:
        return REFUSED if row["status"] in (2, 3) else FAILED
    faults = list(faults)
    if not untold_faults(row, faults):
        return WARNED if faults else RIGHT
    return VAGUE if row["warnings"] else SILENT


def untold_faults(row: dict[str, Any], faults: Iterable[Fault]) -> list[Fault]:
    """Returns the faults of which no warning speaks: none of a code for such a fault, at its place where both have one.

    A scene counts stations from its own start.
    """

    def speaks(said: dict[str, Any], fault: Fault) -> bool:
        if said["code"] not in TOLD_BY[fault.kind]:
            return False
        if said.get("start") is None or math.isnan(fault.place):
            return True
        ends = np.array([said["start"], said["end"]])
        low, high = np.sort(row["to"] - ends if row["reversed"] else row["from"] + ends)
        return bool(low - _SLACK <= fault.place <= high + _SLACK)

    return [fault for fault in faults if not any(speaks(said, fault) for said in row["warnings"])]


_HEAD = ("case", "verdict", "walls mean, cm", "within 10 cm, %", "width, cm", "height, cm", "floor, cm", "from, to, m",
         "sleepers seen", "s", "what is wrong, or said")  # fmt: skip


@dataclass(frozen=True)
class JudgeConfig:
    """Builds each cloud of a folder and judges it by the truth beside it."""

    folder: Annotated[Path, tyro.conf.Positional]  # Folder with inputs and their `NAME_truth.npz`.
    out: Path  # Folder for results and logs; cases with a result there are not built again.
    only: tuple[str, ...] = ()  # Beginnings of the names of the cases needed; all if not given.
    flags: str = ""  # Further words for the builder, in one string.
    keep: bool = False  # Keep the scenes in `OUT/scenes`.


def judge(config: JudgeConfig) -> None:
    """Judges all cases; writes `dirty.md` and `records.json` after each, its figures to `rows`.

    Raises:
        BenchmarkError: The folder holds no cases, or a truth is none.
        OutputError: The folder for the results cannot be written.
    """
    require_folder(config.out)
    rows: list[dict[str, Any]] = []
    for case in find_cases(config.folder, config.only):
        file = config.out / "rows" / f"{case.name}.json"
        if not file.is_file():
            write_file(file, (json.dumps(judge_case(case, config), indent=1) + "\n").encode())
        rows.append(json.loads(file.read_text()))
        _progress.print(f"{case.name}: {rows[-1]['verdict']}", markup=False)
        write_file(config.out / "dirty.md", as_markdown(rows).encode())
        write_records(config.out / "records.json", records_of(rows))
    print(as_markdown(rows))


def judge_case(case: Case, config: JudgeConfig) -> dict[str, Any]:
    """Builds a case by the command line, as a user would, and returns its row of results."""
    scene, log = config.out / "scenes" / case.name, config.out / "logs" / f"{case.name}.txt"
    truth, started = load_truth(case.truth), time.monotonic()
    ran = run_module("scene.build", case.source, "--out", scene, *config.flags.split(), log=log)
    row: dict[str, Any] = {"name": case.name, "seconds": time.monotonic() - started, **ran._asdict(), "warnings": []}
    faults = []
    if ran.status == 0:
        row["warnings"] = json.loads((scene / "manifest.json").read_text()).get("judgement", {}).get("warnings", [])
        row |= judge_scene(scene, truth)
        faults = list_faults(row)
    row |= {"faults": [fault.text for fault in faults], "verdict": judge_build(row, faults)}
    if not config.keep:
        shutil.rmtree(scene, ignore_errors=True)
    return row


def as_markdown(rows: list[dict[str, Any]]) -> str:
    """Returns a table with a line for each case; sizes are median / worst errors, the worst over 1.5 m."""
    lines = []
    for row in rows:
        said = [*row["faults"], row["message"], *(f"[{one['text']}]" for one in row["warnings"])]
        sizes = [" / ".join(filter(None, (_number(row, key) for key in (name, f"{name}_worst"))))
                 for name in ("width", "height", "floor")]  # fmt: skip
        ends = f"{row['from']:.2f}, {row['to']:.2f}" if "from" in row else ""
        sleepers = "" if row.get("sleepers_seen") is None else f"{row['sleepers_seen']} of {row['sleepers']}"
        lines.append([row["name"], row["verdict"], _number(row, "wall_mean", 2), _number(row, "wall_near", 2), *sizes,
                      ends, sleepers, f"{row['seconds']:.0f}", "; ".join(filter(None, said))])  # fmt: skip
    return markdown_table(_HEAD, lines)


def _number(row: dict[str, Any], name: str, digits: int = 1) -> str:
    """Returns a length in cm, or a fraction in %."""
    value = row.get(name)
    return "" if value is None or math.isnan(value) else f"{100.0 * value:.{digits}f}"


def records_of(rows: list[dict[str, Any]]) -> list[Record]:
    """Returns the worst figures of all clouds as records; a cloud that was refused has none."""
    found, command = [], "benchmarks.dirty {shared}/data/dirty_clouds --out out/dirty"
    for id, name, worst, unit in (("wall-mean", "wall_mean", max, "cm"), ("wall-within-10-cm", "wall_near", min, "%")):
        values = [row[name] for row in rows if name in row]
        if values:
            worst_of_all = round(100.0 * worst(values), 2)
            found.append(measured(f"dirty/{id}", worst_of_all, unit, command, n=len(values), split="clouds"))
    return found


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    again = "interrupted; the same command goes on"
    return run_main("dirty", JudgeConfig, judge, description=__doc__, words=words, interrupted=again)


if __name__ == "__main__":
    sys.exit(main())
