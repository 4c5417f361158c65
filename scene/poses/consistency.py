"""Poses against their scans: walls that several sweeps saw are thin where the poses are right, and thick where not.

The thickness of walls in sweeps put together is compared with that in single sweeps. Where it is larger, likely
mistakes are undone one by one: another order of the quaternion, clocks apart, a mount turned. The one that makes the
walls thin is named. Besides the median the thickest fifth counts: a mount that is off in pitch slides upright walls
along themselves, and blurs only what of floor and crown a sensor sees. Where nothing explains the walls, floor and
crown are looked at as they were seen ahead and from behind: a mount that is off in pitch puts one place at two heights.
Such a mount slides upright walls along themselves, and neighbouring sweeps err alike, so walls stay thin. But what lies
`d` ahead is placed `d` times the angle too low, and once it is passed, as much too high.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scene.geometry import arc_length
from scene.poses.registration import deskew
from scene.poses.trajectory import Trajectory
from scene.reading.recording import Recording
from scene.reading.times import Scan

_STRETCH, _STEP = 36.0, 1.0  # m of the way that are looked at, and between two sweeps of it
_MOST_SCANS = 600  # that are read for it
_POINTS_ALONG = 20000  # of each sweep
_BESIDE, _OFF = 1.0, 0.4  # m: half the strip of floor and crown that counts; how far off the LiDAR's height it is
_LEAST_RUN = 0.2  # m in 2 s: a LiDAR that moves less has no heading
_NEAREST, _FURTHEST = 2.0, 20.0  # m along the way between LiDAR and place
_CELL, _IN_CELL = 0.5, 4  # m along the way; returns of a sweep in one
_FIRST = 24  # sweeps, and so m, after which a LiDAR that sees behind itself, even one that came from 12 m outside, has
_LEAST_CELLS = 12  # that were seen both ways
_LEAST_ANGLE = np.deg2rad(0.8)
_SURE = 4.0  # standard errors


@dataclass(frozen=True)
class Tilt:
    """A tilt of the LiDAR along the way, by what it saw both ahead and behind."""

    angle: float  # By which all returns are turned nose down, about the horizontal across the way, rad
    apart: float  # Height between the two sights of one place, median, m
    about: Float[np.ndarray, "3"]  # That horizontal in the LiDAR's axes, to the left of the way

    @property
    def words(self) -> str:
        """The turn that undoes it, by the LiDAR's own axes, for people."""
        axis = int(np.argmax(np.abs(self.about)))
        angle = -np.rad2deg(self.angle) * np.sign(self.about[axis])
        return f"{angle:+.1f}° in {('roll', 'pitch', 'yaw')[axis]}"


def find_tilt(scans: list[Scan], poses: Trajectory) -> Tilt | None:
    """Return the tilt that floor and crown show in sweeps along a way; `None` where they show none."""
    rows, about = [], []
    for scan in scans:
        if not len(scan.points) or not poses.covers(scan.stamp, scan.end):
            continue
        scan = scan.pick(_POINTS_ALONG)
        heading = _heading(poses, scan.stamp)
        if heading is not None:
            position, rotation = poses.at(np.array([scan.stamp]))
            rows.append(_look(deskew(scan, poses), position[0], heading))
            if len(rows) == _FIRST and not any((look[:, 3] < 0).any() for look in rows):
                return None  # it sees nothing behind
            about.append(rotation.inv().apply([-heading[1], heading[0], 0.0])[0])
    if not rows:
        return None
    slopes, apart = _compare(np.concatenate(rows))
    if len(slopes) < _LEAST_CELLS:
        return None
    angle = float(np.median(slopes))
    error = 1.4826 * float(np.median(np.abs(slopes - angle))) / np.sqrt(len(slopes))
    if abs(angle) < max(_LEAST_ANGLE, _SURE * error):
        return None
    return Tilt(angle, float(np.median(np.abs(apart))), np.mean(about, axis=0))


def numbers_along(stamps: Float[np.ndarray, " n"], poses: Trajectory) -> list[int]:
    """Return the numbers of sweeps some way apart about the middle of a recording, by their headers, s."""
    way = arc_length(poses.positions)
    first, begin, due = max(len(stamps) // 2 - _MOST_SCANS // 2, 0), None, -np.inf
    chosen: list[int] = []
    for number in range(first, min(first + _MOST_SCANS, len(stamps))):
        if not poses.covers(stamps[number], stamps[number]):
            continue
        at = float(np.interp(stamps[number], poses.times, way))
        begin = at if begin is None else begin
        if at > begin + _STRETCH:
            break
        if at >= due:
            chosen.append(number)
            due = at + _STEP
    return chosen


def _heading(poses: Trajectory, stamp: float) -> Float[np.ndarray, "2"] | None:
    """Direction of the way in plan at a time; `None` where the LiDAR hardly moves."""
    before, after = poses.at(np.array([stamp - 1.0, stamp + 1.0]))[0][:, :2]
    run = float(np.linalg.norm(after - before))
    return (after - before) / run if run > _LEAST_RUN else None


def _look(
    points: Float[np.ndarray, "p 3"], position: Float[np.ndarray, "3"], heading: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "k 5"]:
    """Return what one sweep shows of floor and crown, by cells in plan: cell x, y, side, distance ahead, height, m."""
    offset = points - position
    ahead, aside = offset[:, :2] @ heading, offset[:, :2] @ np.array([-heading[1], heading[0]])
    near = (np.abs(aside) < _BESIDE) & (np.abs(offset[:, 2]) > _OFF)
    near &= (np.abs(ahead) > _NEAREST) & (np.abs(ahead) < _FURTHEST)
    place = np.floor(points[near, :2] / _CELL)
    cells = np.column_stack([place, np.sign(offset[near, 2]), np.sign(ahead[near])])
    kinds, member, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(member.ravel(), kind="stable")
    groups = np.split(order, np.cumsum(count)[:-1])
    return np.array([
        (*kinds[k, :3], np.median(ahead[near][rows]), np.median(points[near, 2][rows]))
        for k, rows in enumerate(groups) if len(rows) >= _IN_CELL
    ]).reshape(-1, 5)  # fmt: skip


def _compare(table: Float[np.ndarray, "n 5"]) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return tilt, rad, and height between both sights, m, of each cell that was seen ahead and from behind."""
    member = np.unique(table[:, :3], axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(member, kind="stable")
    tilts, heights = [], []
    for rows in np.split(order, np.cumsum(np.bincount(member))[:-1]):
        ahead = table[rows, 3]
        if (ahead > 0).any() and (ahead < 0).any():
            low, high = (np.median(table[rows][side], axis=0)[3:] for side in (ahead > 0, ahead < 0))
            heights.append(high[1] - low[1])
            tilts.append(heights[-1] / (low[0] - high[0]))
    return np.array(tilts), np.array(heights)


_PLACES = (0.25, 0.5, 0.75)  # of the recording
_SCANS, _EVERY = 5, 15  # sweeps at each place, and how far apart
_POINTS = 2500  # of each sweep
_QUERIES, _NEIGHBOURS = 300, 16
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
    tilt: Tilt | None = None  # Of the LiDAR along the way, where the walls show no cause

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
        if self.tilt is not None:
            return (
                f"the poses blur floor and crown: seen ahead, and then from behind, they lie {self.tilt.apart:.2f} m "
                f"apart; with the LiDAR turned by {self.tilt.words} they are thin: the extrinsic is off"
            )
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
    along = numbers_along(recording.stamps, trajectory)
    picked = dict(recording.pick([*(number for group in groups for number in group), *along]))
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
    check = _find_cause(check, trajectory, thickness, orders) if check.blurred else check
    return check if check.cause else replace(check, tilt=find_tilt([picked[number] for number in along], trajectory))


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
