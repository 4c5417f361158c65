"""Scores of estimated trajectories: errors along the tunnel and across it, absolute ones as `evo` defines them."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.command import BenchmarkError
from benchmarks.results import markdown_table
from benchmarks.slam.reading import TRUTH_FILE
from benchmarks.slam.tracks import Alignment, Track, align, axis_from_file, axis_from_path, read_track


def absolute_errors(track: Track) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Returns the error of each position (estimate less truth, fixed frame, m) and of each attitude (rad)."""
    turn = track.true_rotation.inv() * track.rotation
    return track.position - track.true_position, turn.magnitude()


def rms(values: Float[np.ndarray, " n"]) -> float:
    """Returns the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


SCHEMA = "subterra.slam-score/1"
AXIS_FILE = "axis.csv"


@dataclasses.dataclass(frozen=True)
class Score:
    """Errors of one trajectory."""

    name: str  # Name of the recording
    distance: float  # True distance driven between the first and the last scored time, m
    covered: float  # Scored fraction of the recording's duration
    poses: int  # Number of scored poses
    alignment: str  # Alignment of the estimate
    axis: str  # Origin of the directions
    along_final: float  # Last error of the station, m; positive if the estimate lies towards larger stations
    along_rms: float  # RMS error of the station, m
    across_rms: float  # RMS error of the offset to the left of the axis, m
    up_rms: float  # RMS error of the height over the axis, m
    drift: float | None  # |along_final| in % of the distance; `None` without motion
    ape: float  # RMS error of the position, m
    ape_turn: float  # RMS error of the attitude, °
    # Distance driven when the error of the station first exceeds 1 m, m; `None` where it never does
    reach: float | None = None
    late: float | None = None  # How much later the turns show the estimate's clock to be, s; from 10 ms on
    after: float = 0.0  # Time for which the estimate goes on after the truth's end, s
    program: str = ""  # Name of the folder of estimates
    straight: bool = False  # The way has no bend by which `se3` could find the roll


def score_files(
    estimate: Path,
    truth: Path,
    *,
    axis: Path | None = None,
    alignment: Alignment = "origin",
) -> tuple[Score, Float[np.ndarray, "n 3"]]:
    """Scores one TUM file against another; returns its errors of station, offset and height at each pose as well, m.

    Args:
        estimate: TUM file of a SLAM program.
        truth: `lidar.tum` of a recording's truth.
        axis: `axis.csv`; by default the one beside the truth, or else the true path gives the directions.
        alignment: `origin`, `se3` or `none`.

    Raises:
        BenchmarkError: A file is missing or wrong, the trajectories share no times, or the poses are not the LiDAR's.
    """
    track = read_track(estimate, truth, alignment)
    check_rate(estimate, track)
    if alignment == "origin":
        _check_frame(estimate, track)
    elif alignment == "none":
        _check_place(estimate, track)
    if axis is None and (truth.parent / AXIS_FILE).is_file():
        axis = truth.parent / AXIS_FILE
    line = axis_from_path(track.true_position) if axis is None else axis_from_file(axis)
    error, turn = absolute_errors(track)
    parts, travelled = line.coordinates(track.position) - line.coordinates(track.true_position), track.travelled
    distance = float(travelled[-1])
    score = Score(
        name=estimate.stem, distance=distance, covered=track.covered, poses=len(track.time), alignment=alignment,
        axis=line.source, along_final=float(parts[-1, 0]), along_rms=rms(parts[:, 0]), across_rms=rms(parts[:, 1]),
        up_rms=rms(parts[:, 2]), drift=100.0 * abs(float(parts[-1, 0])) / distance if distance > 0.0 else None,
        ape=rms(np.linalg.norm(error, axis=1)), ape_turn=rms(np.degrees(turn)),
        reach=reach_of(travelled, parts[:, 0]), late=track.late, after=track.after,
        straight=_aside(track.true_position) < _STRAIGHT * distance,
    )  # fmt: skip
    return score, parts


LEAST_RATE = 1.0  # poses a second; fewer leave out where a program errs
LEAST_COVERED = 0.9  # fraction of a recording below which an estimate is none
REACH_ERROR = 1.0  # m
_LEAST_AFTER = 1.0  # s after the truth's end that a program may still report


_STRAIGHT = 0.01  # RMS distance of the way from its best line, over its length


def _aside(position: Float[np.ndarray, "n 3"]) -> float:
    """Returns the RMS distance of positions from the line that fits them best, m."""
    spread = np.linalg.svd(position - position.mean(axis=0), compute_uv=False)
    return float(np.linalg.norm(spread[1:])) / np.sqrt(len(position))


def check_rate(estimate: Path, track: Track) -> None:
    """Refuses an estimate of so few poses that the way between them is not scored.

    Raises:
        BenchmarkError: It has less than one pose a second.
    """
    count, run = len(track.time), float(track.time[-1] - track.time[0])
    if count < LEAST_RATE * run:
        raise BenchmarkError(
            f"{estimate}: has {count} poses in {run:.0f} s; at least {LEAST_RATE:g} a second are needed"
        )


_AWAY = 1000.0  # m; nobody is as lost as that in a tunnel


def _check_place(estimate: Path, track: Track) -> None:
    """Refuses poses that are compared as they are and lie beyond any tunnel: those of another frame."""
    nearest = float(np.linalg.norm(absolute_errors(track)[0], axis=1).min())
    if nearest > _AWAY + 10.0 * float(track.travelled[-1]):
        raise BenchmarkError(
            f"{estimate}: lies {1e-3 * nearest:.0f} km from the truth: poses must be in the tunnel's frame, or aligned "
            "by `--alignment origin`"
        )


_TURNED, _FITS = 0.3, 0.05  # fraction of the distance: RMS errors as aligned at the start, and after the best fit


def _check_frame(estimate: Path, track: Track) -> None:
    """Refuses poses whose attitudes belong to another frame, as a camera's: only turned as a whole they fit."""
    distance = float(track.travelled[-1])
    fitted = align(track, "se3")
    before, after = (rms(np.linalg.norm(absolute_errors(one)[0], axis=1)) for one in (track, fitted))
    if before > _TURNED * distance and after < _FITS * distance:
        angle = float(np.degrees((fitted.rotation[0] * track.rotation[0].inv()).magnitude()))
        raise BenchmarkError(
            f"{estimate}: fits the truth only turned as a whole by {angle:.0f}°: poses must be those of the LiDAR, "
            "x forward, also at the start"
        )


def reach_of(travelled: Float[np.ndarray, " n"], along: Float[np.ndarray, " n"]) -> float | None:
    """Returns the distance driven when the error of the station first exceeds 1 m, m; `None` where it never does."""
    beyond = np.flatnonzero(np.abs(along) > REACH_ERROR)
    return float(travelled[beyond[0]]) if len(beyond) else None


@dataclasses.dataclass(frozen=True)
class ScoreConfig:
    """Scores TUM files against the truth.

    Example: python -m benchmarks.slam score --estimate out/slam/poses/arena/evalio-kiss --truth out/arena/truth
    """

    estimate: tuple[Path, ...]  # TUM files, or folders of `NAME.tum`, each folder one program.
    truth: Path  # TUM file, or the `truth/` folder of a set.
    axis: Path | None = None  # `axis.csv`, if it is not beside the truth.
    # `origin`: the first pose is known; `se3`: best fit; `none`: poses in the tunnel's frame.
    alignment: Alignment = "origin"
    out: Path | None = None  # Folder for `scores.json` and `scores.md`.


def score_all(config: ScoreConfig) -> tuple[list[Score], list[str]]:
    """Scores every given estimate; returns a sentence on each that cannot be scored as well.

    Raises:
        BenchmarkError: No estimate is given or can be scored, or a folder has no estimate with known truth.
    """
    if not config.estimate:
        raise BenchmarkError("estimate must name at least one file or folder")
    scores, refused = list[Score](), list[str]()
    for path in config.estimate:
        program = path.name if path.is_dir() else path.parent.name
        for estimate, truth in _pairs(path, config.truth):
            try:
                score, _ = score_files(estimate, truth, axis=config.axis, alignment=config.alignment)
            except BenchmarkError as error:
                refused.append(str(error))
            else:
                scores.append(dataclasses.replace(score, program=program))
    if not scores:
        raise BenchmarkError("; ".join(dict.fromkeys(refused)))
    return scores, refused


def doubts(config: ScoreConfig, scores: list[Score]) -> list[str]:
    """Returns a sentence on each file without truth, each drive not handed in, and poses after a truth's end."""
    said = [f"{one.program} on {one.name}: {one.after:.0f} s of poses lie after the truth's end: another drive?"
            for one in scores if one.after > _LEAST_AFTER]  # fmt: skip
    said += [f"{one.program} on {one.name}: the drive is straight, so `se3` finds no roll: across, up and APE in ° are "
             "those of any roll" for one in scores if one.alignment == "se3" and one.straight]  # fmt: skip
    for folder in (path for path in config.estimate if path.is_dir()):
        given = {path.stem for path in folder.glob("*.tum")}
        known = {path.parent.name for path in config.truth.glob(f"*/{TRUTH_FILE}")}
        said += [f"{folder}: {name}.tum is left out: there is no such drive" for name in sorted(given - known)]
        if missing := sorted(known - given):
            said.append(f"{folder}: holds no poses of {', '.join(missing)}")
    return said


def _find_truth(estimate: Path, truth: Path) -> Path:
    """Returns the file of the truth, also where a set's or one recording's folder is given."""
    if not truth.is_dir():
        return truth
    places = (truth / estimate.stem / TRUTH_FILE, truth / TRUTH_FILE)
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        raise BenchmarkError(f"{truth}: holds no truth of {estimate.stem}: neither {places[0]} nor {places[1]}")
    return file


def _pairs(folder: Path, truth: Path) -> list[tuple[Path, Path]]:
    if not folder.exists():
        raise BenchmarkError(f"{folder}: no such file or folder")
    if not folder.is_dir():
        return [(folder, _find_truth(folder, truth))]
    if not truth.is_dir():
        raise BenchmarkError(f"{truth}: is no folder, and {folder} is one")
    pairs = [(path, truth / path.stem / TRUTH_FILE) for path in sorted(folder.glob("*.tum"))]
    known = [(path, true) for path, true in pairs if true.is_file()]
    if not known:
        raise BenchmarkError(f"{folder}: holds no NAME.tum of a recording whose truth is in {truth}")
    return known


HEAD = (
    "recording", "program", "driven, m", "covered %", "along at the end, m", "drift %", "along, m", "across, m",
    "up, m", "APE, m", "APE, °", "clock late, s",
)  # fmt: skip


def as_rows(scores: list[Score]) -> list[tuple[str, ...]]:
    """Returns the cells of the table below `HEAD`, by recording and program."""

    def cell(value: float | None, digits: int = 2) -> str:
        return "" if value is None else f"{value:.{digits}f}"

    rows: list[tuple[str, ...]] = []
    for s in sorted(scores, key=lambda one: (one.name, one.program)):
        rows.append((
            s.name, s.program, cell(s.distance, 1), cell(100.0 * s.covered, 0), f"{s.along_final:+.2f}",
            cell(s.drift), cell(s.along_rms, 3), cell(s.across_rms, 3), cell(s.up_rms, 3), cell(s.ape, 3),
            cell(s.ape_turn, 2), cell(s.late, 3),
        ))  # fmt: skip
    return rows


def as_markdown(scores: list[Score]) -> str:
    """Returns the table with a note on its columns."""
    return markdown_table(HEAD, as_rows(scores)) + (
        f"\nRoot mean squares over the recording, alignment `{scores[0].alignment}`; APE is that of `evo`. A clock is "
        "late where turns of estimate and truth agree best so; errors stand as they are.\n"
    )


def as_json(scores: list[Score], facts: dict[str, Any]) -> str:
    """Returns `scores.json`."""
    rows = [dataclasses.asdict(one) for one in scores]
    return json.dumps({"schema": SCHEMA, **facts, "scores": rows}, indent=1, default=str) + "\n"
