"""Floor and crown seen ahead and from behind: a mount that is off in pitch puts the same place at two heights.

Such a mount slides upright walls along themselves, and neighbouring sweeps err alike, so walls stay thin. But what lies
`d` ahead is placed `d` times the angle too low, and once it is passed, as much too high.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scene.geometry import arc_length
from scene.poses.registration import deskew
from scene.poses.trajectory import Trajectory
from scene.reading.times import Scan

_STRETCH, _STEP = 36.0, 1.0  # m of the way that are looked at, and between two sweeps of it
_MOST_SCANS = 600  # that are read for it
_POINTS = 20000  # of each sweep
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
        if not len(scan.points) or not poses.covers(scan.stamp, scan.stamp + float(scan.times.max())):
            continue
        pick = np.linspace(0, len(scan.points) - 1, min(_POINTS, len(scan.points))).astype(np.intp)
        scan = Scan(scan.stamp, scan.points[pick], scan.times[pick])
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
