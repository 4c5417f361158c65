"""Offsets between clocks, by turn rates: those of the LiDAR, of an IMU beside it, and of a given trajectory.

Turn rates of instruments on one body are the same vectors but for one rotation, that of their mounts. So the clock of
another instrument is off by the lag at which its rates, turned as fits best, agree most with those that the LiDAR's own
sweeps show.

Source: Wahba, A Least Squares Estimate of Satellite Attitude, 1965: the best rotation, by singular values.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from scene.errors import RecordingError
from scene.poses.imu import Inertial, integrals
from scene.poses.odometry import MIN_POINTS, Guide, Tracker
from scene.poses.trajectory import Trajectory
from scene.reading.recording import Recording
from scene.reading.times import Scan

NOTICED = 0.010  # s; a smaller offset is within what turn rates tell
_SWEEPS, _FEWEST = 100, 40  # that are matched one to the next; with fewer nothing is reported
_PASSES = 3  # times that they are matched: each unwinds sweeps by the motion that the last one found
_POINTS = 6_000  # of a sweep
_WARM_UP = 8  # sweeps that are left out: the map is too thin for them
_REACH, _COARSE, _STEP = 1.5, 0.02, 0.005  # s: largest lag that is tried, and between two lags, far and near
_LIKELY, _AGREE = 0.5, 0.85  # correlations of turn rates from which a lag is looked at closely, and counts
_AS_KNOWN = 0.95  # of the agreement after the best rotation, with which mounts are as they are known
_LIVELY = 0.03  # rad/s, mean size less the mean; a carrier that turns more evenly tells no lag
_LONGEST = 3.0  # times the median size
_FINEST = 1e-4  # rad/s; no axis is known better
_OVERLAP = 0.5  # of the shorter one's time

Timed = TypeVar("Timed", Inertial, Trajectory)
Turns = Callable[[Float[np.ndarray, " k"], Float[np.ndarray, " k"]], Float[np.ndarray, "k 3"]]


@dataclass(frozen=True)
class LidarTurns:
    """Turn rates that sweeps show, one against the next."""

    start: Float[np.ndarray, " k"]  # s
    end: Float[np.ndarray, " k"]  # s
    rate: Float[np.ndarray, "k 3"]  # About the LiDAR's axes, rad/s


def lidar_turns(recording: Recording) -> LidarTurns | None:
    """Match sweeps about the middle of a recording one to the next, without any guide; `None` for too few.

    Raises `RecordingError` where a scan is damaged.
    """
    first = max(recording.scan_count // 2 - _SWEEPS // 2, 0)
    numbers = range(first, min(first + _SWEEPS, recording.scan_count))
    scans = [scan.pick(_POINTS) for _, scan in recording.pick(numbers) if len(scan.points) >= MIN_POINTS]
    if len(scans) < _FEWEST:
        return None
    guide = None
    for _ in range(_PASSES):
        tracker, times = Tracker(), list[float]()
        for scan in scans:
            begin = float(scan.times.min())  # the first beams may have met nothing
            scan = Scan(scan.stamp + begin, scan.points, scan.times - begin)
            middle = scan.stamp + 0.5 * float(scan.times.max())
            if not times or middle > times[-1]:
                tracker.register(scan, middle, guide)
                times.append(middle)
        poses = tracker.trajectory(times, "sweeps")
        guide = Guide(poses, True, np.inf, np.inf)  # a sweep is unwound by its own motion, not by that before it
    at, turns = poses.times[_WARM_UP:], poses.rotations[_WARM_UP:]
    steps = (turns[:-1].inv() * turns[1:]).as_rotvec() / np.diff(at)[:, None]
    return LidarTurns(at[:-1], at[1:], steps)


def turns_of_gyro(inertial: Inertial, mount: Float[np.ndarray, "3 3"] | None = None) -> Turns:
    """Return the mean turn rates of an IMU over intervals of its own clock, rad/s.

    They are about the LiDAR's axes where the rotation of its `mount` against the LiDAR is known.
    """
    rate = inertial.rate if mount is None else inertial.rate @ mount

    def rates(start: np.ndarray, end: np.ndarray) -> np.ndarray:
        angle = [integrals(at, inertial.times, rate) for at in (start, end)]
        return (angle[1] - angle[0]) / (end - start)[:, None]

    return rates


def turns_of_poses(poses: Trajectory) -> Turns:
    """Return the mean turn rates of a trajectory over intervals of its own clock, rad/s."""

    def rates(start: np.ndarray, end: np.ndarray) -> np.ndarray:
        return (poses.at(start)[1].inv() * poses.at(end)[1]).as_rotvec() / (end - start)[:, None]

    return rates


def find_lag(lidar: LidarTurns, other: Turns) -> tuple[float | None, float]:
    """Return how much later the other clock shows the turns of the LiDAR, s, and the correlation of the turns then.

    The lag is `None` where the turns do not tell; the correlation is NaN where the LiDAR hardly turns.
    """
    own = _even(lidar.rate)
    if float(np.linalg.norm(own, axis=1).mean()) < _LIVELY:
        return None, np.nan

    def agree(lag: float) -> float:
        return _agreement(own, _even(other(lidar.start + lag, lidar.end + lag)))

    near = max(np.arange(-_REACH, _REACH + _COARSE, _COARSE), key=agree)
    best = max(np.arange(near - _COARSE, near + _COARSE, _STEP), key=agree)
    if (here := agree(best)) < _LIKELY or abs(best) >= _REACH:
        return None, here
    # Now each axis counts by its own noise: a LiDAR that sees little of floor and crown hardly knows its pitch.
    there = other(lidar.start + best, lidar.end + best)
    turn = _rotation(own, _even(there))
    off = np.linalg.norm(lidar.rate - there @ turn.T, axis=1)
    sure = off <= _LONGEST * np.median(off)
    start, end, rate = lidar.start[sure], lidar.end[sure], lidar.rate[sure]

    def turned(lag: float) -> Float[np.ndarray, "k 3"]:
        return other(start + lag, end + lag) @ turn.T

    def noise(lag: float) -> float:
        return float(np.log((rate - turned(lag)).var(axis=0) + _FINEST**2).sum())

    best = min(np.arange(best - 2 * _COARSE, best + 2 * _COARSE, _STEP), key=noise)
    one, two = (part - part.mean(axis=0) for part in (rate, turned(best)))
    here = _agreement(*(part / np.hypot((one - two).std(axis=0), _FINEST) for part in (one, two)))
    if here < _AGREE:
        return None, here
    before, least, after = (noise(best + side) for side in (-_STEP, 0.0, _STEP))
    bend = before - 2.0 * least + after
    return float(best + (0.5 * _STEP * (before - after) / bend if bend > 0 else 0.0)), here


def _even(rate: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    """Return rates less their mean, a gyro's bias, none longer than thrice the usual: a wrong match counts no more."""
    rate = rate - np.median(rate, axis=0)
    size = np.linalg.norm(rate, axis=1, keepdims=True)
    return rate * np.minimum(1.0, _LONGEST * np.median(size) / np.maximum(size, 1e-12))


def _rotation(one: Float[np.ndarray, "k 3"], other: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation of `other` that suits one best: none where that does nearly as well, as for known mounts."""
    if float(np.sum(one * other)) > _AS_KNOWN * _agreement(one, other) * np.linalg.norm(one) * np.linalg.norm(other):
        return np.eye(3)
    left, _, right = np.linalg.svd(one.T @ other)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left) * np.linalg.det(right)]) @ right


def _agreement(one: Float[np.ndarray, "k 3"], other: Float[np.ndarray, "k 3"]) -> float:
    """Return the correlation of two rows of vectors after the rotation that suits them best."""
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    if size < 1e-12:
        return 0.0
    left, values, right = np.linalg.svd(one.T @ other)
    values[2] *= np.sign(np.linalg.det(left) * np.linalg.det(right))
    return float(values.sum()) / size


@dataclass(frozen=True)
class Clock:
    """The offset of another clock, as the turns tell it."""

    of: str  # Whose clock: a topic, or the trajectory
    offset: float | None  # By which it is later than the LiDAR's, s; `None` where the turns do not tell
    corrected: bool = False  # True where it was set right
    agreement: float = np.nan  # Correlation of its turns with the LiDAR's; NaN where nobody knows

    @property
    def facts(self) -> dict[str, Any]:
        known = {"clock_of": self.of, "clock_offset": self.offset, "clock_corrected": self.corrected}
        return {**known, "clock_doubt": self.words}

    @property
    def words(self) -> str | None:
        """Sentence for the user; `None` where nothing is wrong, or no longer."""
        if self.offset is None and self.agreement < _AGREE:
            return (
                f"the turns of {self.of} are not those of the LiDAR (correlation {self.agreement:.2f}): it is of "
                f"another drive, or more than {_REACH:g} s off"
            )
        if self.offset is None or abs(self.offset) < NOTICED or self.corrected:
            return None
        side = "late" if self.offset > 0 else "early"
        return (
            f"the clock of {self.of} is {abs(self.offset):.3f} s {side} against the LiDAR's, as the motion of both "
            "shows; --clock auto sets it right"
        )


def settle(
    recording: Recording, other: Timed, auto: bool, mount: Float[np.ndarray, "3 3"] | None = None
) -> tuple[Clock, Timed]:
    """Return what the turns of sweeps and of another instrument tell of their clocks, and it by the LiDAR's clock.

    `mount` is the rotation of an IMU against the LiDAR. Raises `RecordingError` where the two share no time, and not
    `auto`.
    """
    if isinstance(other, Inertial):
        of, turns = f"the IMU {other.topic}", turns_of_gyro(other, mount)
    else:
        of, turns = f"the trajectory {other.path.name}", turns_of_poses(other)
    apart = find_gap(recording, of, other.times, auto)
    lag, agreement = _lag(recording, lambda start, end: turns(start + apart, end + apart))
    offset = None if lag is None and not apart else apart + (lag or 0.0)
    if offset is None or abs(offset) < NOTICED:
        return Clock(of, offset, agreement=agreement), other
    return Clock(of, offset, auto, agreement), replace(other, times=other.times - offset)


def _lag(recording: Recording, other: Turns) -> tuple[float | None, float]:
    """Return the lag of another clock, s, `None` where the turns do not tell, and their correlation.

    Where nothing reported whether a header is of the start or the end of its sweep, and the other clock is early by the
    length of a sweep, the headers are of the end.
    """
    lidar, times = lidar_turns(recording), recording.convention
    lag, agreement = (None, np.nan) if lidar is None else find_lag(lidar, other)
    if lag is None or not times.guessed or times.length < 2 * NOTICED or abs(lag + times.length) > 3 * NOTICED:
        return lag, agreement
    recording.take_end()
    print(f"point times {recording.facts['point_times']}", flush=True)
    lidar = lidar_turns(recording)
    return (None, np.nan) if lidar is None else find_lag(lidar, other)


def find_gap(recording: Recording, of: str, times: Float[np.ndarray, " n"], auto: bool) -> float:
    """Return how far the beginnings of two clocks are apart that share no time, s; 0 where they do.

    Raises `RecordingError` where they share none, and not `auto`.
    """
    begin, end = float(recording.stamps.min()), float(recording.stamps.max())
    first, last = float(times[0]), float(times[-1])
    if min(end, last) - max(begin, first) >= _OVERLAP * min(end - begin, last - first):
        return 0.0
    if auto:
        return first - begin
    raise RecordingError(
        f"{recording.path}: {of} runs from {first:.2f} to {last:.2f} s, but the LiDAR {recording.topic} from "
        f"{begin:.2f} to {end:.2f} s: their clocks are {first - begin:.6g} s apart; --clock auto lays their "
        "beginnings on each other"
    )
