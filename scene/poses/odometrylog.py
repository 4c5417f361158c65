"""What an odometry has tracked so far, in pieces on disk, each written once.

The map of small-gicp cannot be read back, but it follows from the thinned sweeps and their poses: these are kept, and
an odometry that goes on puts them into a new map without registering them again.
"""

from dataclasses import dataclass, field

import numpy as np

from scene.reading.recording import START, Place
from scene.resume import Partial


@dataclass
class Tracked:
    """Sweeps in the order of time.

    Attributes:
        times: Middle of each, s.
        poses: `(4, 4)` each.
        weakest: See `Odometry`.
        thinned: Points of each as they went into the map, m, `(k, 3)`; only of those that were read back.
        place: How far the recording has been read.
        done: Whether that was all of it.
    """

    times: list[float] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)
    weakest: list[np.ndarray] = field(default_factory=list)
    thinned: list[np.ndarray] = field(default_factory=list)
    place: Place = START
    done: bool = False


class OdometryLog:
    """The pieces of one odometry among the partial results."""

    def __init__(self, partial: Partial, name: str) -> None:
        self._partial, self._name = partial, name
        self._pieces = self._written = 0
        self._fresh: list[np.ndarray] = []

    def read(self) -> Tracked:
        """All whole pieces from the first on."""
        tracked = Tracked()
        while not tracked.done and (piece := self._piece(len(tracked.times))) is not None:
            tracked.times.extend(float(time) for time in piece["times"])
            tracked.poses.extend(piece["poses"])
            tracked.weakest.extend(piece["weakest"])
            tracked.thinned.extend(np.split(piece["points"], np.cumsum(piece["sizes"])[:-1]))
            tracked.place = Place.from_array(piece["place"])
            tracked.done = bool(piece["done"])
            self._pieces += 1
        self._written = len(tracked.times)
        return tracked

    def add(self, tracked: Tracked, time: float, pose: np.ndarray, weakest: np.ndarray, thinned: np.ndarray) -> None:
        """Appends one sweep; its points are only held until they are written."""
        tracked.times.append(time)
        tracked.poses.append(pose)
        tracked.weakest.append(weakest)
        if self._partial.keeps:
            self._fresh.append(thinned.copy())

    def due(self) -> bool:
        """Whether it is time to write."""
        return self._partial.due()

    def write(self, tracked: Tracked, place: Place, done: bool = False) -> None:
        """Writes what has been added since the last piece."""
        tracked.place, tracked.done = place, done
        if not self._partial.keeps or not tracked.times:
            return
        new = slice(self._written, None)
        self._partial.save(
            f"{self._name}-{self._pieces:04d}",
            start=np.array(self._written),
            times=np.array(tracked.times[new]),
            poses=np.array(tracked.poses[new]).reshape(-1, 4, 4),
            weakest=np.array(tracked.weakest[new]).reshape(-1, 3),
            sizes=np.array([len(points) for points in self._fresh], np.int64),
            points=np.concatenate([np.empty((0, 3)), *self._fresh]),
            place=place.as_array(),
            done=np.array(done),
        )
        self._pieces, self._written, self._fresh = self._pieces + 1, len(tracked.times), []

    def _piece(self, start: int) -> dict[str, np.ndarray] | None:
        """The next piece, if it goes on where the last one ended."""
        piece = self._partial.load(f"{self._name}-{self._pieces:04d}")
        return piece if piece is not None and int(piece["start"]) == start else None
