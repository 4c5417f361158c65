"""Score files or whole folders of estimates."""

import dataclasses
from pathlib import Path

from benchmarks.slam.errors import SlamError
from benchmarks.slam.score import Curve, Score, score_files
from benchmarks.slam.tracks import Alignment

TRUTH_FILE = "lidar.tum"


@dataclasses.dataclass(frozen=True)
class ScoreConfig:
    """What to score against what.

    Attributes:
        estimate: TUM files, or folders of `NAME.tum`, each folder one program.
        truth: TUM file, or the `truth/` folder of a set.
        axis: `axis.csv`, where it is not beside the truth.
        alignment: `origin`: the first pose is known; `se3`: best fit; `none`: poses in the tunnel's frame.
        piece: Length of the pieces of path whose errors are told, m.
        out: Folder for `scores.json`, `scores.md` and `scores.png`.
    """

    estimate: tuple[Path, ...]
    truth: Path
    axis: Path | None = None
    alignment: Alignment = "origin"
    piece: float = 10.0
    out: Path | None = None


@dataclasses.dataclass(frozen=True)
class Judged:
    """A score, the program that it belongs to, and the errors on the way."""

    program: str
    score: Score
    curve: Curve


def judge(config: ScoreConfig) -> list[Judged]:
    """Every estimate that was given.

    Raises:
        SlamError: None was given, a file is missing or wrong, or a folder holds no estimate of a recording whose
            truth is known.
    """
    if not config.estimate:
        raise SlamError("estimate must name at least one file or folder")
    return [judged for given in config.estimate for judged in _judge(given, config)]


def _judge(given: Path, config: ScoreConfig) -> list[Judged]:
    if not given.exists():
        raise SlamError(f"{given}: no such file or folder")
    pairs = _pairs(given, config.truth) if given.is_dir() else [(given, _truth_of(given, config.truth))]
    program, found = given.name if given.is_dir() else given.parent.name, []
    for estimate, truth in pairs:
        score, curve = score_files(
            estimate, truth, axis=config.axis, alignment=config.alignment, piece=config.piece, name=estimate.stem
        )
        found.append(Judged(program, score, curve))
    return found


def _truth_of(estimate: Path, truth: Path) -> Path:
    """The truth's file, where a folder was given: a set's, or one recording's."""
    if not truth.is_dir():
        return truth
    places = (truth / estimate.stem / TRUTH_FILE, truth / TRUTH_FILE)
    there = next((place for place in places if place.is_file()), None)
    if there is None:
        raise SlamError(f"{truth}: holds no truth of {estimate.stem}: neither {places[0]} nor {places[1]} is there")
    return there


def _pairs(folder: Path, truth: Path) -> list[tuple[Path, Path]]:
    if not truth.is_dir():
        raise SlamError(f"{truth}: is no folder, and {folder} is one")
    found = [(path, truth / path.stem / TRUTH_FILE) for path in sorted(folder.glob("*.tum"))]
    known = [(path, true) for path, true in found if true.is_file()]
    if not known:
        raise SlamError(f"{folder}: holds no NAME.tum of a recording whose truth is in {truth}")
    return known
