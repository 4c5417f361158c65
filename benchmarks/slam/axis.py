"""The tunnel's axis: where along it and how far aside of it a position is, in a surveyor's terms."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from benchmarks.slam.errors import SlamError

_HEADER = "station,x,y,z"
_SPACING = 0.25  # m between points of an axis that is made from a path
_SMOOTHED = 8  # points of such an axis to either side over which it is smoothed
_LEAST_STRETCH = 0.2  # of a station's length at the offset of a point: beyond the centre of a bend it means nothing
_ROWS = 1000  # positions looked up in one go


@dataclasses.dataclass(frozen=True)
class Axis:
    """An axis as a polyline; beyond its ends it goes straight on.

    Attributes:
        station: Of its points, growing, m, `(n,)`.
        position: m, `(n, 3)`.
        frames: Rows are the unit vectors along, left and up, `(n, 3, 3)`.
        source: Where it comes from, for the report.
    """

    station: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "n 3"]
    frames: Float[np.ndarray, "n 3 3"]
    source: str

    def nearest(self, position: Float[np.ndarray, "k 3"]) -> Int[np.ndarray, " k"]:
        """The axis' point nearest to each position."""
        parts = np.split(position, range(_ROWS, len(position), _ROWS))
        squares = [np.sum((part[:, None] - self.position) ** 2, axis=2) for part in parts]
        return np.concatenate([np.argmin(square, axis=1) for square in squares])

    def placed(self, position: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
        """Station, offset to the left and height over the axis of each position, m."""
        near = self.nearest(position)
        aside = np.einsum("kij,kj->ki", self.frames[near], position - self.position[near])
        curvature = np.sum(np.gradient(self.frames[:, 0], self.station, axis=0) * self.frames[:, 1], axis=1)
        inside = (near > 0) & (near < len(self.station) - 1)
        # Off the axis a metre of station is longer on the outside of a bend and shorter inside.
        stretch = np.where(inside, np.maximum(1.0 - curvature[near] * aside[:, 1], _LEAST_STRETCH), 1.0)
        return np.column_stack([self.station[near] + aside[:, 0] / stretch, aside[:, 1:]])

    def resolved(self, vectors: Float[np.ndarray, "k 3"], at: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
        """Vectors of the fixed frame as parts along, left and up of the axis near some positions."""
        return np.einsum("kij,kj->ki", self.frames[self.nearest(at)], vectors)


def axis_from_file(path: Path) -> Axis:
    """The `axis.csv` of a recording's truth.

    Raises:
        SlamError: The file is missing or is no axis.
    """
    try:
        with path.open() as file:
            if file.readline().strip() != _HEADER:
                raise SlamError(f"{path}: not an axis: its first line must be {_HEADER!r}")
            rows = np.loadtxt(file, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        raise SlamError(f"{path}: not a readable axis ({error})") from error
    if rows.shape[1:] != (4,) or len(rows) < 2 or not np.isfinite(rows).all() or (np.diff(rows[:, 0]) <= 0.0).any():
        raise SlamError(f"{path}: an axis has at least 2 finite rows of 4 numbers, its stations growing")
    return Axis(rows[:, 0], rows[:, 1:], _frames(rows[:, 1:]), path.name)


def axis_from_path(position: Float[np.ndarray, "n 3"]) -> Axis:
    """The true path as an axis: smoothed over two metres, up to the pose furthest from its start.

    Whoever drives there and back is thus measured by the way there.

    Raises:
        SlamError: It nowhere moves by a metre.
    """
    out = position[: int(np.argmax(np.linalg.norm(position - position[0], axis=1))) + 1]
    steps = np.linalg.norm(np.diff(out, axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    if travelled[-1] < 1.0:
        raise SlamError(
            f"the true path moves by {travelled[-1]:.2f} m and no axis was given: nothing tells along from across"
        )
    kept = np.concatenate([[True], steps > 0.0])
    station = np.linspace(0.0, travelled[-1], max(2, round(travelled[-1] / _SPACING) + 1))
    line = np.stack([np.interp(station, travelled[kept], column) for column in out[kept].T], axis=-1)
    return Axis(station, line, _frames(_smoothed(line)), "the true path")


def _smoothed(line: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Means over neighbours, as many to either side as there are on both."""
    total, n = np.concatenate([np.zeros((1, 3)), np.cumsum(line, axis=0)]), len(line)
    index = np.arange(n)
    reach = np.minimum(np.minimum(index, n - 1 - index), _SMOOTHED)
    return (total[index + reach + 1] - total[index - reach]) / (2 * reach + 1)[:, None]


def _frames(line: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    left = np.cross([0.0, 0.0, 1.0], along)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([along, left, np.cross(along, left)], axis=1)
