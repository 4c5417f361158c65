"""Estimated and true trajectories at the same times, and the tunnel's axis that their errors are resolved along."""

import dataclasses
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.command import BenchmarkError
from scene.errors import RecordingError
from scene.poses.clocks import NOTICED, LidarTurns, find_lag, turns_of_poses
from scene.poses.trajectory import Trajectory, load_tum

_HEADER = "station,x,y,z"
_SPACING = 0.25  # m between points of an axis made from a path
_SMOOTHED = 8  # points to either side over which such an axis is smoothed
_LEAST_STRETCH = 0.2  # least length of 1 m of station at a point's offset: it has no meaning beyond a bend's centre


@dataclasses.dataclass(frozen=True)
class Axis:
    """A tunnel's axis as a polyline; it continues straight beyond its ends."""

    station: Float[np.ndarray, " n"]  # Stations of its points, increasing, m
    position: Float[np.ndarray, "n 3"]  # Positions of its points, m
    frames: Float[np.ndarray, "n 3 3"]  # Unit vectors along, left and up as rows
    source: str  # Origin of the axis, for the report

    def coordinates(self, position: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
        """Returns station, offset to the left and height over the axis of each position, m."""
        near = cKDTree(self.position).query(position)[1]
        aside = np.einsum("kij,kj->ki", self.frames[near], position - self.position[near])
        curvature = np.sum(np.gradient(self.frames[:, 0], self.station, axis=0) * self.frames[:, 1], axis=1)
        inside = (near > 0) & (near < len(self.station) - 1)
        # A metre of station is longer on the outside of a bend and shorter on the inside.
        stretch = np.where(inside, np.maximum(1.0 - curvature[near] * aside[:, 1], _LEAST_STRETCH), 1.0)
        return np.column_stack([self.station[near] + aside[:, 0] / stretch, aside[:, 1:]])


def axis_from_file(path: Path) -> Axis:
    """Reads the `axis.csv` of a recording's truth.

    Raises:
        BenchmarkError: The file is missing or is no axis.
    """
    try:
        with path.open() as file:
            if file.readline().strip() != _HEADER:
                raise BenchmarkError(f"{path}: not an axis: its first line must be {_HEADER!r}")
            rows = np.loadtxt(file, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        raise BenchmarkError(f"{path}: not a readable axis ({error})") from error
    if rows.shape[1:] != (4,) or len(rows) < 2 or not np.isfinite(rows).all() or (np.diff(rows[:, 0]) <= 0.0).any():
        raise BenchmarkError(f"{path}: an axis has at least 2 finite rows of 4 numbers with increasing stations")
    return Axis(rows[:, 0], rows[:, 1:], _frames(rows[:, 1:]), path.name)


def axis_from_path(position: Float[np.ndarray, "n 3"]) -> Axis:
    """Makes an axis of the true path: smoothed over 2 m to either side, up to the pose furthest from its start.

    A drive there and back is thus measured along the way there.

    Raises:
        BenchmarkError: The path is shorter than 1 m.
    """
    outward = position[: int(np.argmax(np.linalg.norm(position - position[0], axis=1))) + 1]
    steps = np.linalg.norm(np.diff(outward, axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    if travelled[-1] < 1.0:
        raise BenchmarkError(
            f"the true path moves by {travelled[-1]:.2f} m and no axis was given: nothing tells along from across"
        )
    kept = np.concatenate([[True], steps > 0.0])
    station = np.linspace(0.0, travelled[-1], max(2, round(travelled[-1] / _SPACING) + 1))
    line = np.stack([np.interp(station, travelled[kept], column) for column in outward[kept].T], axis=-1)
    return Axis(station, line, _frames(_smooth(line)), "the true path")


def _smooth(line: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Returns means over neighbours, as many on one side as on the other."""
    total, index = np.concatenate([np.zeros((1, 3)), np.cumsum(line, axis=0)]), np.arange(len(line))
    reach = np.minimum(np.minimum(index, index[::-1]), _SMOOTHED)
    return (total[index + reach + 1] - total[index - reach]) / (2 * reach + 1)[:, None]


def _frames(line: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    left = np.cross([0.0, 0.0, 1.0], along)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([along, left, np.cross(along, left)], axis=1)


Alignment = Literal["origin", "se3", "none"]
_TURNS = 3000  # of an estimate that tell its clock
_SLACK = 1e-3  # s: a stamp this far outside the truth's span still counts as its end


@dataclasses.dataclass(frozen=True)
class Track:
    """Estimated and true poses at the same times."""

    time: Float[np.ndarray, " n"]  # Times, increasing, s
    position: Float[np.ndarray, "n 3"]  # Estimated positions, m
    rotation: Rotation  # Estimated attitudes, `n` of them
    true_position: Float[np.ndarray, "n 3"]  # True positions, m
    true_rotation: Rotation  # True attitudes, `n` of them
    covered: float  # Fraction of the truth's duration between the first and the last of these times
    after: float  # Time for which the estimate goes on after the truth's end, s
    late: float | None = None  # By how much the turns show the estimate's clock to be late, s; from 10 ms on

    @property
    def travelled(self) -> Float[np.ndarray, " n"]:
        """True distance driven since the first time, m."""
        steps = np.linalg.norm(np.diff(self.true_position, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


def read_track(estimate: Path, truth: Path, alignment: Alignment = "origin") -> Track:
    """Reads both files at the estimate's times, with the truth interpolated and the estimate aligned to it.

    Args:
        estimate: TUM file of a SLAM program.
        truth: TUM file of the recording's truth.
        alignment: See `align`.

    Raises:
        BenchmarkError: A file is missing or wrong, or they share fewer than two times.
    """
    try:
        both = load_tum(estimate), load_tum(truth)
    except RecordingError as error:
        raise BenchmarkError(str(error)) from error
    turns, at = [turns_of_poses(poses) for poses in both], both[0].times[:: len(both[0].times) // _TURNS + 1]
    lag, _ = find_lag(LidarTurns(at[:-1], at[1:], turns[0](at[:-1], at[1:])), turns[1])
    late = None if lag is None or abs(lag) < NOTICED else -lag
    return dataclasses.replace(align(_pair(*both), alignment), late=late)


def _pair(estimated: Trajectory, true: Trajectory) -> Track:
    begin, end = true.times[0], true.times[-1]
    some = np.flatnonzero((estimated.times >= begin - _SLACK) & (estimated.times <= end + _SLACK))
    if len(some) < 2:
        raise BenchmarkError(
            f"{estimated.source}: shares {len(some)} of its {len(estimated.times)} times ({estimated.times[0]:.3f} to "
            f"{estimated.times[-1]:.3f} s) with {true.source} ({begin:.3f} to {end:.3f} s); at least 2 are needed"
        )
    time = estimated.times[some]
    position, rotation = true.at(time)
    covered = float((time[-1] - time[0]) / (end - begin))
    after, moved = max(0.0, float(estimated.times[-1] - end)), (estimated.positions[some], estimated.rotations[some])
    return Track(time, *moved, position, rotation, min(covered, 1.0), after)


def align(track: Track, alignment: Alignment) -> Track:
    """Moves the estimate as a whole: `origin` puts its first pose on the true one, `se3` fits all by least squares.

    The motion is rigid. A scale is never fitted, since the error of scale along the tunnel is what matters. `none`
    leaves poses in their frame, for programs that localise in the given map.

    Source of `se3`: Umeyama 1991, Least-squares estimation of transformation parameters between two point patterns.
    """
    if alignment == "none":
        return track
    if alignment == "origin":
        turn = track.true_rotation[0] * track.rotation[0].inv()
        shift = track.true_position[0] - turn.apply(track.position[0])
    else:
        middle, true_middle = track.position.mean(axis=0), track.true_position.mean(axis=0)
        covariance = (track.true_position - true_middle).T @ (track.position - middle)
        left, _, right = np.linalg.svd(covariance)
        mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
        turn = Rotation.from_matrix(left @ mirror @ right)
        shift = true_middle - turn.apply(middle)
    return dataclasses.replace(track, position=turn.apply(track.position) + shift, rotation=turn * track.rotation)
