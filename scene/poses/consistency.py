"""Poses against their scans: walls that several sweeps saw are thin where the poses are right, and thick where not.

The thickness of walls in sweeps put together is compared with that in single sweeps. Where it is larger, likely
mistakes are undone one by one: another order of the quaternion, clocks apart, a mount turned. The one that makes the
walls thin is named. Besides the median the thickest fifth counts: a mount that is off in pitch slides upright walls
along themselves, and blurs only what of floor and crown a sensor sees.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scene.poses.registration import deskew
from scene.poses.trajectory import Trajectory
from scene.reading.recording import Recording
from scene.reading.times import Scan

_PLACES = (0.25, 0.5, 0.75)  # of the recording
_SCANS, _EVERY = 5, 15  # sweeps at each place, and how far apart
_POINTS = 2500  # of each sweep
_QUERIES, _NEIGHBOURS = 300, 16  # points of a scan that are looked at, and points about each that tell a wall
_LONGEST = 25.0  # m; returns further away are far apart
_BLURRED, _LEAST = 1.3, 0.012  # times the thickness in a sweep, and m, from which walls count as blurred
_THICKEST, _WORSE, _LEAST_WORSE = 0.8, 1.35, 0.015  # quantile; the same limits for the thickest fifth
_EXPLAINS = 0.7  # a mistake that is named brings the thickness below this share
_MIN_GAIN = 0.004  # m
_SHIFTS = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0)  # s
_TURNS = (1.0, 2.0, 3.0, 5.0)  # deg
_AXES = ("roll", "pitch", "yaw")


@dataclass(frozen=True)
class PoseCheck:
    """Agreement of poses with their scans."""

    thickness: float  # Of walls in several sweeps together, m, standard deviation
    expected: float  # Of walls in single sweeps, m
    upper: float  # That which a fifth of the places of several sweeps exceeds, m
    upper_expected: float  # The same of single sweeps, m
    cause: str = ""  # The mistake that explains the difference, in words; empty where none was found
    wxyz: bool = False  # True where the quaternions are in the order w, x, y, z

    @property
    def blurred(self) -> bool:
        """True where the poses make the walls thicker than the scanner does."""
        return self._mostly or self.upper > max(_WORSE * self.upper_expected, _LEAST_WORSE)

    @property
    def _mostly(self) -> bool:
        return self.thickness > max(_BLURRED * self.expected, _LEAST)

    @property
    def compared(self) -> tuple[float, float]:
        """Thickness that tells, in several sweeps and in single ones, m: the median, or else the thickest fifth."""
        return (self.thickness, self.expected) if self._mostly else (self.upper, self.upper_expected)

    @property
    def facts(self) -> dict[str, Any]:
        return {"wall_thickness": self.thickness, "wall_thickness_in_a_sweep": self.expected, "pose_doubt": self.words}

    @property
    def words(self) -> str | None:
        """Sentence for the user; `None` where nothing is wrong."""
        if not self.blurred:
            return None
        likely = self.cause or "the poses, their clock or the mount of the LiDAR may be wrong"
        here, expected = (f"{1000 * value:.0f} mm" for value in self.compared)
        part = "" if self._mostly else " in the thickest fifth"
        return f"the poses blur the walls: {here} thick{part} where a single sweep has {expected}; {likely}"


def check_poses(recording: Recording, trajectory: Trajectory, orders: bool = True) -> PoseCheck | None:
    """Compares poses with some sweeps of a recording; `None` where they share too few sweeps to tell.

    Another order of the quaternions is only tried with `orders`: what the user has said is not detected away. Raises
    `RecordingError` where a scan is damaged.
    """
    groups = [_numbers_of_place(place, recording.scan_count) for place in _PLACES]
    picked = dict(recording.pick(number for group in groups for number in group))
    places = [
        [picked[number].pick(_POINTS, _near(picked[number])) for number in group if _usable(picked[number], trajectory)]
        for group in groups
    ]
    places = [group for group in places if len(group) >= 2]
    if not places:
        return None

    def thickness(poses: Trajectory, turn: Rotation | None = None, single: bool = False) -> tuple[float, float]:
        return _measure(places, poses, turn, single)

    (expected, upper_expected), (given, upper) = thickness(trajectory, single=True), thickness(trajectory)
    check = PoseCheck(given, expected, upper, upper_expected)
    return _find_cause(check, trajectory, thickness, orders) if check.blurred else check


def reorder(trajectory: Trajectory) -> Trajectory:
    """Return the poses with quaternions read as w, x, y, z instead of x, y, z, w."""
    wxyz = trajectory.rotations.as_quat()
    rotations = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]])
    return Trajectory(trajectory.times, trajectory.positions, rotations, trajectory.source)


def _numbers_of_place(place: float, count: int) -> list[int]:
    """Return the numbers of a few sweeps at a share of the recording."""
    first = int(place * max(count - _SCANS * _EVERY, 0))
    return list(range(first, min(first + _SCANS * _EVERY, count), _EVERY))


def _near(scan: Scan) -> np.ndarray:
    distance = np.linalg.norm(scan.points, axis=1)
    return np.flatnonzero((distance > 1.0) & (distance < _LONGEST))


def _usable(scan: Scan, trajectory: Trajectory) -> bool:
    """Return whether a sweep has poses, and enough returns nearby."""
    rows = min(_POINTS, len(_near(scan)))
    return rows > 10 * _NEIGHBOURS and trajectory.covers(scan.stamp, scan.end)


def _measure(places: list[list[Scan]], poses: Trajectory, turn: Rotation | None, single: bool) -> tuple[float, float]:
    """Median thickness of the walls and that of the thickest fifth, m: in each sweep alone, or in all of a place."""
    result = []
    for group in places:
        clouds = [
            deskew(scan if turn is None else Scan(scan.stamp, turn.apply(scan.points), scan.times), poses)
            for scan in group
        ]
        if single:
            result.append(np.concatenate([_thickness(cloud, _QUERIES // len(clouds)) for cloud in clouds]))
        else:
            result.append(_thickness(np.concatenate(clouds), _QUERIES))
    middle, upper = np.quantile(np.concatenate(result), [0.5, _THICKEST])
    return float(middle), float(upper)


def _thickness(points: np.ndarray, queries: int) -> Float[np.ndarray, " q"]:
    """Standard deviation of neighbouring points across the plane through them, m."""
    pick = np.linspace(0, len(points) - 1, queries).astype(np.intp)
    near = points[cKDTree(points).query(points[pick], _NEIGHBOURS)[1]]
    offset = near - near.mean(axis=1, keepdims=True)
    spread = np.linalg.eigvalsh(np.einsum("qni,qnj->qij", offset, offset) / _NEIGHBOURS)
    return np.sqrt(np.maximum(spread[:, 0], 0.0))


def _find_cause(
    check: PoseCheck, poses: Trajectory, thickness: Callable[..., tuple[float, float]], orders: bool
) -> PoseCheck:
    """Undo likely mistakes one by one, and name the one that makes the walls thin."""
    given = check.compared[0]
    which = 0 if given == check.thickness else 1
    limit = min(_EXPLAINS * given, given - _MIN_GAIN)
    found = [(np.inf, "", False)]
    if orders:
        found.append((thickness(reorder(poses))[which], "the quaternions are in the order w, x, y, z", True))
    for shift in (sign * size for size in _SHIFTS for sign in (1, -1)):
        side = "later" if shift > 0 else "earlier"
        words = f"with the poses {abs(shift):g} s {side} they are thin: two clocks differ"
        moved = Trajectory(poses.times + shift, poses.positions, poses.rotations, poses.source)
        found.append((thickness(moved)[which], words, False))
    for axis, name in enumerate(_AXES):
        for angle in (sign * size for size in _TURNS for sign in (1, -1)):
            words = f"with the LiDAR turned by {angle:+g}° in {name} they are thin: the extrinsic is off"
            turn = Rotation.from_euler("xyz"[axis], angle, degrees=True)
            found.append((thickness(poses, turn)[which], words, False))
    best, words, wxyz = min(found, key=lambda row: row[0])
    return check if best > limit else replace(check, cause=words, wxyz=wxyz)
