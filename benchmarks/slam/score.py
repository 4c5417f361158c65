"""The score of one estimated trajectory."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.slam.axis import Axis, axis_from_file, axis_from_path
from benchmarks.slam.errors import SlamError
from benchmarks.slam.metrics import Spread, absolute, pairs_by_distance, relative, rms
from benchmarks.slam.tracks import Alignment, Track, read_track

SCHEMA = "subterra.slam-score/1"
AXIS_FILE = "axis.csv"


@dataclasses.dataclass(frozen=True)
class Score:
    """Errors of one trajectory.

    Attributes:
        name: Of the recording.
        distance: True distance driven between the first and the last scored time, m.
        covered: Share of the recording's duration that was scored, 1.
        poses: Scored poses.
        alignment: How the estimate was aligned.
        axis: Where the directions come from.
        along_final: Last error of the station, m; positive where the estimate lies towards growing stations.
        along_rms: Root mean square error of the station, m.
        across_rms: The same of the offset from the axis to the left.
        up_rms: The same of the height over the axis.
        drift: |along_final| in % of the distance.
        piece: Length of the pieces of path for the four figures that follow, m.
        piece_along: RMS error of a piece's motion, seen from where it begins, along the axis, in % of its length; None
            where no piece is so long.
        piece_across: The same to the left.
        piece_turn: RMS error of a piece's turn, °/m.
        rpe: Spread of the whole errors of the pieces, m.
        ape: Spread of the position errors, m.
        ape_turn: Spread of the orientation errors, °.
    """

    name: str
    distance: float
    covered: float
    poses: int
    alignment: str
    axis: str
    along_final: float
    along_rms: float
    across_rms: float
    up_rms: float
    drift: float | None
    piece: float
    piece_along: float | None
    piece_across: float | None
    piece_turn: float | None
    rpe: Spread | None
    ape: Spread
    ape_turn: Spread

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return dataclasses.asdict(self)


@dataclasses.dataclass(frozen=True)
class Curve:
    """Errors on the way: `travelled (n,)` and `error (n, 3)` of station, offset and height, m."""

    travelled: Float[np.ndarray, " n"]
    error: Float[np.ndarray, "n 3"]


def score_files(
    estimate: Path,
    truth: Path,
    *,
    axis: Path | None = None,
    alignment: Alignment = "origin",
    piece: float = 10.0,
    name: str = "",
) -> tuple[Score, Curve]:
    """Score one TUM file against another.

    Args:
        estimate: What a SLAM program wrote.
        truth: `lidar.tum` of a recording's truth.
        axis: `axis.csv`; the one beside the truth if left out, or else the true path gives the directions.
        alignment: `origin`, `se3` or `none`.
        piece: Length of the pieces of path whose errors are told, m.
        name: Of the recording; the estimate's file name if left out.

    Raises:
        SlamError: A file is missing or wrong, or the trajectories share no times.
    """
    if not piece > 0.0:
        raise SlamError(f"piece must be above 0 m, got {piece}")
    track = read_track(estimate, truth, alignment)
    if axis is None and (truth.parent / AXIS_FILE).is_file():
        axis = truth.parent / AXIS_FILE
    line = axis_from_path(track.true_position) if axis is None else axis_from_file(axis)
    return score(track, line, alignment, piece, name or estimate.stem)


def score(track: Track, axis: Axis, alignment: str, piece: float, name: str) -> tuple[Score, Curve]:
    """Score an aligned track, and its errors on the way."""
    error, turn = absolute(track)
    parts, travelled = axis.placed(track.position) - axis.placed(track.true_position), track.travelled
    distance = float(travelled[-1])
    found = Score(
        name=name, distance=distance, covered=track.covered, poses=len(track.time), alignment=alignment,
        axis=axis.source, along_final=float(parts[-1, 0]), along_rms=rms(parts[:, 0]), across_rms=rms(parts[:, 1]),
        up_rms=rms(parts[:, 2]), drift=100.0 * abs(float(parts[-1, 0])) / distance if distance > 0.0 else None,
        piece=piece, ape=Spread.of(np.linalg.norm(error, axis=1)), ape_turn=Spread.of(np.degrees(turn)),
        **_pieces(track, axis, piece),
    )  # fmt: skip
    return found, Curve(travelled, parts)


def _pieces(track: Track, axis: Axis, piece: float) -> dict[str, Any]:
    pairs = pairs_by_distance(track, piece)
    if not len(pairs):
        return {"piece_along": None, "piece_across": None, "piece_turn": None, "rpe": None}
    error, turn = relative(track, pairs)
    length = np.diff(track.travelled[pairs], axis=1)  # a little more than `piece`
    parts = axis.resolved(error, track.true_position[pairs.sum(axis=1) // 2]) / length
    return {
        "piece_along": 100.0 * rms(parts[:, 0]),
        "piece_across": 100.0 * rms(parts[:, 1]),
        "piece_turn": float(np.degrees(rms(turn / length[:, 0]))),
        "rpe": Spread.of(np.linalg.norm(error, axis=1)),
    }
