"""Two programs of ours that see motion where walls are smooth: by their brightness, and by the Doppler of each return.

Attitude comes from the gyroscope, levelled at rest. Along the axis, brightness is unrolled about the sensor and matched
with a mosaic of the wall passed so far; Doppler speeds give the velocity itself.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from benchmarks.command import BenchmarkError
from benchmarks.slam.reading import Poses, read_samples

CELL = 0.05  # m, of the unrolled wall
_REACH, _ROUND, _COLUMNS = 6.0, 352, 512  # m either way that are used; cells round the wall; cells along that are kept
_SHIFTS = np.arange(-0.24, 0.241, 0.03)  # m about the place that is expected
_LEAST = 0.15  # correlation below which brightness says nothing
_BLEND = 0.3  # of a new speed
_STRIP = 2  # cells round whose brightness is compared with their mean
_SWEEP = 0.1  # s
_CHANGE = 1e-6  # of the logarithm of the intensity: below, it is constant

Step = Callable[[np.ndarray, Rotation, np.ndarray], Float[np.ndarray, "3"]]


class Mosaic:
    """Brightness of the wall passed lately, by cell of station and angle."""

    def __init__(self) -> None:
        self.total, self.count = np.zeros((_COLUMNS, _ROUND)), np.zeros((_COLUMNS, _ROUND))
        self._newest = -_COLUMNS

    def add(self, station: Float[np.ndarray, "n"], angle: Float[np.ndarray, "n"], value: np.ndarray) -> None:
        """Adds points at stations, m, and angles, rad; cells that held an earlier part begin anew."""
        column = np.floor(station / CELL).astype(int)
        newest = int(column.max())
        fresh = np.arange(max(self._newest, newest - _COLUMNS) + 1, newest + 1) % _COLUMNS
        self.total[fresh], self.count[fresh], self._newest = 0.0, 0.0, max(newest, self._newest)
        cell = column % _COLUMNS, _cell_round(angle)
        np.add.at(self.total, cell, value)
        np.add.at(self.count, cell, 1.0)

    def likeness(self, station: Float[np.ndarray, "n"], angle: Float[np.ndarray, "n"], value: np.ndarray) -> float:
        """Returns the correlation of points with what was seen there; 0 where too little was."""
        place, row = station / CELL - 0.5, _cell_round(angle)
        low = np.floor(place).astype(int)
        fraction, total, count = place - low, 0.0, 0.0
        for column, weight in ((low, 1.0 - fraction), (low + 1, fraction)):
            total = total + weight * self.total[column % _COLUMNS, row]
            count = count + weight * self.count[column % _COLUMNS, row]
        known = np.asarray(count) > 0.5
        if known.sum() < 100:
            return 0.0
        return float(np.corrcoef(value[known], (total / np.where(known, count, 1.0))[known])[0, 1])


def _cell_round(angle: Float[np.ndarray, "n"]) -> np.ndarray:
    return np.floor((0.5 + angle / (2.0 * np.pi)) * _ROUND).astype(int) % _ROUND


def unroll(points: Float[np.ndarray, "n 3"], intensity: Float[np.ndarray, "n"]) -> tuple[np.ndarray, ...]:
    """Returns distances along the axis (m), angles round it (rad) and how bright a sweep is there, beside its mean.

    Args:
        points: Points about the sensor, m; the axis is ahead.
        intensity: Intensities that do not fall with the range.
    """
    near = (np.abs(points[:, 0]) < _REACH) & (intensity > 0.0) & (np.abs(points[:, 1:]).sum(axis=1) > 0.5)
    ray, seen = points[near], intensity[near]
    middle = 0.5 * (np.percentile(ray[:, 1:], 1.0, axis=0) + np.percentile(ray[:, 1:], 99.0, axis=0))
    angle = np.arctan2(*(ray[:, 1:] - middle).T)
    # The cosine of incidence is a number of the angle over the range: all that is the same along the wall goes.
    value = np.log(seen) + np.log(np.linalg.norm(ray, axis=1))
    strip = _cell_round(angle) // _STRIP
    mean = np.bincount(strip, value) / np.maximum(np.bincount(strip), 1)
    return ray[:, 0], angle, value - mean[strip]


def by_brightness() -> Step:
    """Returns a step that finds the way along the axis by brightness."""
    mosaic, at, speed, axis = Mosaic(), 0.0, 0.0, np.zeros(0)

    def step(points: np.ndarray, attitude: Rotation, turn: np.ndarray) -> Float[np.ndarray, "3"]:
        nonlocal at, speed, axis
        rays = np.column_stack([points["x"], points["y"], points["z"]]).astype(float)
        late = 1e-9 * points["t"].astype(float) - _SWEEP
        rays = attitude.apply(rays + np.cross(turn, rays) * late[:, None])
        if not axis.size:
            if np.ptp(np.log(points["intensity"][points["intensity"] > 0.0], dtype=float)) < _CHANGE:
                raise BenchmarkError("its intensities are constant: a program that reads brightness sees nothing")
            axis = np.linalg.eigh(np.cov(rays[:, :2].T))[1][:, 1]
            axis = axis * np.sign(axis[0])
        ahead = rays[:, :2] @ axis
        left = axis[0] * rays[:, 1] - axis[1] * rays[:, 0]
        straight = np.column_stack([ahead + speed * late, left, rays[:, 2]])
        along, angle, value = unroll(straight, points["intensity"].astype(float))
        expected = at + _SWEEP * speed
        likeness = np.array([mosaic.likeness(expected + shift + along, angle, value) for shift in _SHIFTS])
        best = int(np.argmax(likeness))
        moved = expected
        if likeness[best] > _LEAST and 0 < best < len(_SHIFTS) - 1:
            left_of, here, right_of = likeness[best - 1 : best + 2]
            bend = max(2.0 * here - left_of - right_of, 1e-9)
            moved = expected + _SHIFTS[best] + 0.5 * (_SHIFTS[1] - _SHIFTS[0]) * (right_of - left_of) / bend
        speed += _BLEND * ((moved - at) / _SWEEP - speed)
        at = moved
        mosaic.add(at + along, angle, value)
        return np.array([at * axis[0], at * axis[1], 0.0])

    return step


def by_doppler() -> Step:
    """Returns a step that adds up the velocity by which the speeds of all returns agree."""
    position = np.zeros(3)

    def step(points: np.ndarray, attitude: Rotation, turn: np.ndarray) -> Float[np.ndarray, "3"]:
        nonlocal position
        if "velocity" not in (points.dtype.names or ()):
            raise BenchmarkError("its points have no velocity: it is no recording of a Doppler LiDAR")
        rays = np.column_stack([points["x"], points["y"], points["z"]]).astype(float)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        velocity = -np.linalg.lstsq(rays, points["velocity"].astype(float), rcond=None)[0]
        middle = attitude * Rotation.from_rotvec(-0.5 * _SWEEP * turn)
        position = position + _SWEEP * middle.apply(velocity)
        return position

    return step


def run(make: Callable[[], Step], recording: Path) -> Poses:
    """Runs a step over the sweeps of a recording; poses are of the ends of sweeps."""
    step, turns, forces = make(), [], []
    attitude, bias, last, seconds = Rotation.identity(), np.zeros(3), 0, 0.0
    rows: list[tuple[float, np.ndarray]] = []
    for stamp, content in read_samples(recording):
        started = time.perf_counter()
        if isinstance(content, tuple):
            forces.append(content[0])
            turns.append(content[1])
            if last and rows:
                attitude = attitude * Rotation.from_rotvec(1e-9 * (stamp - last) * (content[1] - bias))
            last = stamp
        else:
            if not rows:
                attitude, bias = _level(np.mean(forces, axis=0)), np.mean(turns, axis=0)
            seen = content[(content["x"] != 0.0) | (content["y"] != 0.0)]
            rate: Any = np.mean(turns[-20:], axis=0) - bias
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = attitude.as_matrix(), step(seen, attitude, rate)
            rows.append((1e-9 * stamp + _SWEEP, pose))
        seconds += time.perf_counter() - started
    return np.array([t for t, _ in rows]), np.array([pose for _, pose in rows]).reshape(-1, 4, 4), seconds


def _level(force: Float[np.ndarray, "3"]) -> Rotation:
    """Returns the attitude of a sensor at rest, without yaw, from the specific force."""
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], [force / np.linalg.norm(force)])[0]
