"""The bore's returns, its axis, and a list of all that cleaning cut away, with place and cause."""

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from scene.cloud import Cloud
from scene.geometry import Axis


class Cause(IntEnum):
    """Why a point of the uncleaned cloud was cut away; its `words` are for people."""

    KEPT = 0
    SCATTERED = 1
    BEHIND = 2
    INSIDE = 3
    BEYOND = 4
    BRANCH = 5
    ELSEWHERE = 6
    STANDING = 7

    @property
    def words(self) -> str:
        return _WORDS[self]


_WORDS = (
    "the bore",
    "scattered returns without neighbours",
    "returns behind the wall",
    "things inside the bore",
    "terrain or a cutting beyond a mouth",
    "a branch or a recess",
    "another tunnel or building apart from the bore",
    "things that stand along a plane wall",
)
OUTSIDE = (Cause.BEYOND, Cause.BRANCH, Cause.ELSEWHERE, Cause.STANDING)  # of the bore: no model of it need explain them

_ROOT = 20  # percent of a branch's points, those nearest the bore, that are its mouth
_BRANCH = 3.0  # m behind the wall: less is a niche
_BUILDING = 2000  # points
_MOUTH = 1.2  # m behind the wall: nearer returns of a branch are those of its mouth
_MOUTHS_APART, _MOUTH_POINTS = 1.5, 20  # m along; points
_MUCH = 1.5  # times as long as its mouth: a branch that runs beside the bore, too


@dataclass(frozen=True)
class Removed:
    """One stretch of the cloud that was cut away.

    Stations below 0 or above the bore's length lie beyond its ends.
    """

    start: float  # First station, m
    end: float  # Last station, m
    cause: Cause
    points: int  # Points of the thinned cloud in it
    place: tuple[float, float, float]  # Its middle, of a branch that of its mouth, in the input's frame, m
    nearest: float = 0.0  # How far behind the wall it begins, m
    deepest: float = 0.0  # How far behind the wall it ends, m
    mouths: tuple[tuple[float, float], ...] = ()  # First and last stations at which a branch opens into the bore, m

    @property
    def facts(self) -> dict[str, Any]:
        """Entries for the manifest."""
        return {**vars(self), "cause": self.cause.words, "code": self.cause.name.lower(), "warning": self.warning}

    @property
    def warning(self) -> str:
        """Sentence for the user; empty where the cut is usual."""
        x, y, z = self.place
        where = f"from station {self.start:.0f} to {self.end:.0f} m, near ({x:.1f}, {y:.1f}, {z:.1f}),"
        if self.cause == Cause.BRANCH and self.deepest > _BRANCH:
            return (
                f"{where} the bore opens into a branch or a room that reaches {self.deepest:.0f} m behind its wall"
                f"{self._name_mouths()}; it was cut at its mouth: build it from a cloud of its own"
            )
        if self.cause == Cause.ELSEWHERE and self.points > _BUILDING:
            return f"{where} another tunnel or building stands {self.nearest:.0f} m behind the wall; it was left out"
        return ""

    def _name_mouths(self) -> str:
        """Return where a branch opens that runs on beside the bore; empty where it opens over its length."""
        open_over = sum(end - start for start, end in self.mouths)
        if not self.mouths or self.end - self.start < _MUCH * open_over + _BRANCH:
            return ""
        told = " and ".join(f"from {start:.0f} to {end:.0f} m" for start, end in self.mouths)
        return f", and meets it {told}, where that wall is a guess"

    def shifted(self, by: float) -> "Removed":
        mouths = tuple((start + by, end + by) for start, end in self.mouths)
        return replace(self, start=self.start + by, end=self.end + by, mouths=mouths)

    def reversed(self, length: float) -> "Removed":
        """Return the same stretch by stations that count from the other end of an axis of `length`, m."""
        mouths = tuple((length - end, length - start) for start, end in reversed(self.mouths))
        return replace(self, start=length - self.end, end=length - self.start, mouths=mouths)


@dataclass(frozen=True)
class Cleaned:
    """The returns of one bore, and what was cut away."""

    cloud: Cloud  # The bore's returns; the same object as the input where nothing was cut
    axis: Axis  # Centreline of the bore, m
    removed: tuple[Removed, ...]  # By station of `axis`, m
    cause: Int[np.ndarray, " n"]  # `Cause` of each point of the uncleaned cloud
    behind: Float[np.ndarray, "k 3"]  # Places on plane walls, where things may hide them, m


def part_of_cloud(cloud: Cloud, rows: Int[np.ndarray, " k"]) -> Cloud:
    """Return some of a cloud's points; the number of returns read stays what it was."""
    return replace(cloud, points=cloud.points[rows], weights=cloud.weights[rows])


def list_removed(
    cloud: Cloud,
    cause: Int[np.ndarray, " n"],
    station: Float[np.ndarray, " n"],
    gap: float,
    behind: Float[np.ndarray, " n"] | None = None,
) -> tuple[Removed, ...]:
    """List stretches of points with one cause, no two points of a stretch further apart than `gap` along it, m.

    `behind` is how far each point is behind the wall, m; what a user should know of gets a warning by it.
    """
    result = []
    for index in np.unique(cause[cause != Cause.KEPT]):
        rows = np.flatnonzero(cause == index)
        rows = rows[np.argsort(station[rows], kind="stable")]
        for part in np.split(rows, np.flatnonzero(np.diff(station[rows]) > gap) + 1):
            named, depth = part, np.zeros(2)
            mouths: tuple[tuple[float, float], ...] = ()
            if behind is not None:
                depth = np.percentile(behind[part], [1, 99])
                if index == Cause.BRANCH:  # one goes to its mouth to look, and not to the middle of what was cut
                    named = part[behind[part] <= np.percentile(behind[part], _ROOT)]
                    mouths = _find_mouths(station[part], behind[part])
            x, y, z = (float(v) for v in np.median(cloud.points[named].astype(np.float64), axis=0) + cloud.origin)
            first, last = (float(station[part[end]]) for end in (0, -1))
            depths = float(depth[0]), float(depth[1])
            result.append(Removed(first, last, Cause(index), len(part), (x, y, z), *depths, mouths))
    return tuple(sorted(result, key=lambda part: (part.start, part.cause)))


def _find_mouths(station: Float[np.ndarray, " n"], behind: Float[np.ndarray, " n"]) -> tuple[tuple[float, float], ...]:
    """Return first and last stations, which grow, of the stretches in which a branch comes near the wall, m."""
    near = station[behind < _MOUTH]
    parts = np.split(near, np.flatnonzero(np.diff(near) > _MOUTHS_APART) + 1)
    return tuple((float(part[0]), float(part[-1])) for part in parts if len(part) >= _MOUTH_POINTS)
