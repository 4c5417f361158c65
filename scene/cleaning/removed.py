"""The bore's returns, its axis, and a list of all that cleaning cut away, with place and cause."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from scene.bore import Axis
from scene.cloud import Cloud

# Each point of the uncleaned cloud has one of these, by its index.
KEPT, SCATTERED, BEHIND, INSIDE, BEYOND, BRANCH, ELSEWHERE = range(7)
CAUSES = (
    "the bore",
    "scattered returns without neighbours",
    "returns behind the wall",
    "things inside the bore",
    "terrain or a cutting beyond a mouth",
    "a branch or a recess",
    "another tunnel or building apart from the bore",
)

_BRANCH = 3.0  # m behind the wall: less is a niche
_BUILDING = 2000  # points


@dataclass(frozen=True)
class Removed:
    """One stretch of the cloud that was cut away.

    Stations below 0 or above the bore's length lie beyond its ends.
    """

    start: float  # First station, m
    end: float  # Last station, m
    cause: str  # One of `CAUSES`
    points: int  # Points of the thinned cloud in it
    place: tuple[float, float, float]  # Median position in the input's frame, m
    nearest: float = 0.0  # How far behind the wall it begins, m
    deepest: float = 0.0  # How far behind the wall it ends, m

    @property
    def warning(self) -> str:
        """Sentence for the user; empty where the cut is usual."""
        x, y, z = self.place
        where = f"from station {self.start:.0f} to {self.end:.0f} m, near ({x:.1f}, {y:.1f}, {z:.1f}),"
        if self.cause == CAUSES[BRANCH] and self.deepest > _BRANCH:
            return (
                f"{where} the bore opens into a branch or a room that reaches {self.deepest:.0f} m behind its wall; it "
                "was cut at its mouth: build it from a cloud of its own"
            )
        if self.cause == CAUSES[ELSEWHERE] and self.points > _BUILDING:
            return f"{where} another tunnel or building stands {self.nearest:.0f} m behind the wall; it was left out"
        return ""

    def shifted(self, by: float) -> "Removed":
        """Return the same stretch with stations that are `by` m larger."""
        return replace(self, start=self.start + by, end=self.end + by)

    def reversed(self, length: float) -> "Removed":
        """Return the same stretch by stations that count from the other end of an axis of `length`, m."""
        return replace(self, start=length - self.end, end=length - self.start)


@dataclass(frozen=True)
class Cleaned:
    """The returns of one bore, and what was cut away."""

    cloud: Cloud  # The bore's returns; the same object as the input where nothing was cut
    axis: Axis  # Centreline of the bore, m
    removed: tuple[Removed, ...]  # By station of `axis`, m
    cause: Int[np.ndarray, " n"]  # Index into `CAUSES` of each point of the uncleaned cloud


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
    for index in np.unique(cause[cause != KEPT]):
        rows = np.flatnonzero(cause == index)
        rows = rows[np.argsort(station[rows], kind="stable")]
        for part in np.split(rows, np.flatnonzero(np.diff(station[rows]) > gap) + 1):
            x, y, z = np.median(cloud.points[part].astype(np.float64), axis=0) + cloud.origin
            first, last = (float(station[part[end]]) for end in (0, -1))
            depth = (0.0, 0.0) if behind is None else np.percentile(behind[part], [1, 99])
            place = (float(x), float(y), float(z))
            result.append(Removed(first, last, CAUSES[index], len(part), place, float(depth[0]), float(depth[1])))
    return tuple(sorted(result, key=lambda part: (part.start, part.cause)))
