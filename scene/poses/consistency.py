"""Poses against their scans: walls that several sweeps saw are thin where the poses are right, and thick where not.

The thickness of walls in sweeps put together is compared with that in single sweeps. Where it is larger, likely
mistakes are undone one by one: another order of the quaternion, clocks apart, a mount turned. The one that makes the
walls thin is named. A mount that is off in pitch slides upright walls along themselves, and blurs only what of floor
and crown a sensor sees: so a turn that makes these much thinner is a mistake, too.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scene.poses.trajectory import Trajectory, deskew
from scene.reading.recording import Recording
from scene.reading.times import Scan

_PLACES = (0.25, 0.5, 0.75)  # of the recording
_SCANS, _EVERY = 5, 15  # sweeps at each place, and how far apart
_POINTS = 2500  # of each sweep
_QUERIES, _NEIGHBOURS = 300, 16  # points of a scan that are looked at, and points about each that tell a wall
_LONGEST = 25.0  # m; returns further away are far apart
_BLURRED, _LEAST = 1.3, 0.012  # times the thickness in a sweep, and m, from which walls count as blurred
_LEVEL, _FEW_LEVEL = 0.8, 20  # upright part of the normals of floor and crown; fewer queries there tell nothing
_TILTED = 0.75  # fraction of the thickness of floor and crown below which a turn that brings them there is a mistake
_EXPLAINS = 0.7  # a mistake that is named brings the thickness below this fraction
_MIN_GAIN = 0.004  # m
_SHIFTS = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0)  # s
_TURNS = (1.0, 2.0, 3.0, 5.0)  # deg
_AXES = {"x": "roll", "y": "pitch", "z": "yaw"}


@dataclass(frozen=True)
class PoseCheck:
    """Agreement of poses with their scans."""

    thickness: float  # Of walls in several sweeps together, m, standard deviation
    expected: float  # Of walls in single sweeps, m
    level: float = np.nan  # Of floor and crown in several sweeps, m; NaN where too little of them is seen
    level_best: float = np.nan  # The same with the LiDAR turned as makes it thinnest, m
    cause: str = ""  # The mistake that explains the difference, in words; empty where none was found
    wxyz: bool = False  # True where the quaternions are in the order w, x, y, z

    @property
    def blurred(self) -> bool:
        """True where the poses make walls, or floor and crown, thicker than the scanner does."""
        return self.upright or self.level_best < min(_TILTED * self.level, self.level - _MIN_GAIN)

    @property
    def upright(self) -> bool:
        """True where walls of any direction are too thick."""
        return self.thickness > max(_BLURRED * self.expected, _LEAST)

    @property
    def facts(self) -> dict[str, Any]:
        return {"wall_thickness": self.thickness, "wall_thickness_in_a_sweep": self.expected, "pose_doubt": self.words}

    @property
    def words(self) -> str | None:
        """Sentence for the user; `None` where nothing is wrong."""
        if not self.blurred:
            return None
        likely = self.cause or "poses, their clock or the LiDAR's mount may be wrong, or the odometry stood still"
        what, here, other, when = (
            ("the walls", self.thickness, self.expected, "where a single sweep has")
            if self.upright
            else ("floor and crown", self.level, self.level_best, "and could have")
        )
        return f"the poses blur {what}: {1000 * here:.0f} mm thick {when} {1000 * other:.0f} mm; {likely}"


def check_poses(recording: Recording, trajectory: Trajectory, orders: bool = True) -> PoseCheck | None:
    """Compares poses with some sweeps of a recording; `None` where they share too few sweeps to tell.

    Another order of the quaternions is only tried with `orders`: what the user has said is not detected away. Raises
    `RecordingError` where a scan is damaged.
    """
    count, span = recording.scan_count, _SCANS * _EVERY  # sweeps
    first = [int(place * max(count - span, 0)) for place in _PLACES]
    groups = [range(number, min(number + span, count), _EVERY) for number in first]
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

    (expected, _), (given, level) = thickness(trajectory, single=True), thickness(trajectory)
    turned = {mount: thickness(trajectory, Rotation.from_euler(*mount, degrees=True)) for mount in _mounts()}
    tilted = min((mount for mount in turned if mount[0] != "z"), key=lambda mount: turned[mount][1])
    check = PoseCheck(given, expected, level, turned[tilted][1])
    if not check.blurred:
        return check
    limit = min(_EXPLAINS * given, given - _MIN_GAIN)
    found = [(np.inf, "", False)]
    if orders:
        found.append((thickness(reorder(trajectory))[0], "the quaternions are in the order w, x, y, z", True))
    for shift in (sign * size for size in _SHIFTS for sign in (1, -1)):
        side = "later" if shift > 0 else "earlier"
        words = f"with the poses {abs(shift):g} s {side} they are thin: two clocks differ"
        found.append((thickness(replace(trajectory, times=trajectory.times + shift))[0], words, False))
    found += [(thick, _describe_mount(mount), False) for mount, (thick, _) in turned.items()]
    best, words, wxyz = min(found, key=lambda row: row[0])
    if best <= limit:
        return replace(check, cause=words, wxyz=wxyz)
    return check if check.upright else replace(check, cause=_describe_mount(tilted))


def _mounts() -> list[tuple[str, float]]:
    return [(axis, sign * size) for axis in _AXES for size in _TURNS for sign in (1, -1)]


def _describe_mount(mount: tuple[str, float]) -> str:
    return f"with the LiDAR turned by {mount[1]:+g}° in {_AXES[mount[0]]} they are thin: the extrinsic is off"


def reorder(trajectory: Trajectory) -> Trajectory:
    """Return the poses with quaternions read as w, x, y, z instead of x, y, z, w."""
    wxyz = trajectory.rotations.as_quat()
    rotations = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]])
    return Trajectory(trajectory.times, trajectory.positions, rotations, trajectory.source)


def _near(scan: Scan) -> np.ndarray:
    distance = np.linalg.norm(scan.points, axis=1)
    return np.flatnonzero((distance > 1.0) & (distance < _LONGEST))


def _usable(scan: Scan, trajectory: Trajectory) -> bool:
    """Return whether a sweep has poses, and enough returns nearby."""
    rows = min(_POINTS, len(_near(scan)))
    return rows > 10 * _NEIGHBOURS and trajectory.covers(scan.stamp, scan.end)


def _measure(places: list[list[Scan]], poses: Trajectory, turn: Rotation | None, single: bool) -> tuple[float, float]:
    """Median thickness of all walls, and of floor and crown, m: in each sweep alone, or in all of a place."""
    result = []
    for group in places:
        clouds = [
            deskew(scan if turn is None else Scan(scan.stamp, turn.apply(scan.points), scan.times), poses)
            for scan in group
        ]
        result += [_thickness(cloud, _QUERIES // len(clouds)) for cloud in clouds] if single else [
            _thickness(np.concatenate(clouds), _QUERIES)
        ]  # fmt: skip
    thick, upright = np.concatenate(result, axis=1)
    level = thick[upright > _LEVEL]
    return float(np.median(thick)), float(np.median(level)) if len(level) >= _FEW_LEVEL else np.nan


def _thickness(points: np.ndarray, queries: int) -> Float[np.ndarray, "2 q"]:
    """Standard deviation of neighbouring points across their plane, m, and the upright part of its normal."""
    pick = np.linspace(0, len(points) - 1, queries).astype(np.intp)
    near = points[cKDTree(points).query(points[pick], _NEIGHBOURS)[1]]
    offset = near - near.mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("qni,qnj->qij", offset, offset) / _NEIGHBOURS)
    return np.stack([np.sqrt(np.maximum(spread[:, 0], 0.0)), np.abs(axes[:, 2, 0])])
