"""Poses over time, what they make of a sweep, and TUM files of them or of a prism without attitude."""

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from scene.errors import RecordingError, require_input
from scene.reading.source import cause
from scene.reading.times import Scan, seconds_in

_NUMBER = re.compile(r"[-+]?\.?\d[^a-zA-Z]")
_HEADER = re.compile(r"(?i)\bq_?(?:rs_)?[wx]")
_QUATERNION_TOLERANCE = 0.01  # by which the length of a quaternion may differ from 1
_KNOTS = 21  # poses interpolated per sweep; between two of them, 5 ms, a walker's motion is straight


@dataclass(frozen=True)
class Trajectory:
    """Sensor poses in a fixed frame."""

    times: Float[np.ndarray, " n"]  # s, growing
    positions: Float[np.ndarray, "n 3"]  # m
    rotations: Rotation  # Sensor to fixed frame, `n` of them
    source: str  # Origin of the poses, for messages
    order: str | None = None  # Of quaternions, `xyzw` or `wxyz`, where the file's header says so

    @property
    def path(self) -> Path:
        """The file that the poses were read from."""
        return Path(self.source)

    @cached_property
    def _slerp(self) -> Slerp:
        return Slerp(self.times, self.rotations)

    @cached_property
    def _columns(self) -> Float[np.ndarray, "4 n"]:
        """Times and positions axis by axis: `np.interp` would copy columns of rows whole at every call."""
        return np.stack([self.times, *self.positions.T])

    def covers(self, start: float, end: float) -> bool:
        """Return whether poses exist over the whole interval, s."""
        return bool(self.times[0] <= start and end <= self.times[-1])

    def at(self, times: Float[np.ndarray, " k"]) -> tuple[Float[np.ndarray, "k 3"], Rotation]:
        """Return positions (linear) and rotations (slerp) at times, s; beyond the ends the nearest pose holds."""
        clipped = np.clip(times, self.times[0], self.times[-1])
        known, *columns = self._columns
        positions = np.stack([np.interp(clipped, known, column) for column in columns], axis=1)
        return positions, self._slerp(clipped)


def deskew(scan: Scan, trajectory: Trajectory) -> Float[np.ndarray, "n 3"]:
    """Return the scan's points in the trajectory's frame, m."""
    span = float(scan.times.max(initial=0.0))
    knots = np.linspace(0.0, max(span, 1e-9), _KNOTS)
    positions, rotations = trajectory.at(scan.stamp + knots)
    at = scan.times / knots[-1] * (_KNOTS - 1)
    low = np.minimum(at.astype(np.intp), _KNOTS - 2)
    fraction = (at - low)[:, None]
    matrices = rotations.as_matrix()
    points = scan.points.astype(np.float64)

    def from_pose(knot: np.ndarray) -> np.ndarray:
        return np.einsum("nij,nj->ni", matrices[knot], points) + positions[knot]

    return (1 - fraction) * from_pose(low) + fraction * from_pose(low + 1)


def save_tum(trajectory: Trajectory, path: Path) -> None:
    """Writes `t x y z qx qy qz qw` rows."""
    rows = np.column_stack([trajectory.times, trajectory.positions, trajectory.rotations.as_quat()])
    np.savetxt(path, rows, fmt="%.9f")


def read_rows(path: Path, kind: str) -> tuple[Float[np.ndarray, "n k"], list[str]]:
    """Reads rows of numbers of one length, and the names of their columns where a header has them.

    Columns are apart by white space, commas, semicolons or tabs; decimals may have a comma. The first column is a time,
    s, or since 1970 in ms, us or ns. No rows from an empty file. Raises `RecordingError` where it is not `kind`.
    """
    require_input(path)
    try:
        lines = [line.strip() for line in path.read_text("utf-8-sig").splitlines() if line.strip()]
        first = next((k for k, line in enumerate(lines) if _NUMBER.match(line)), 0)
        header = next((line for line in reversed(lines[:first]) if _HEADER.search(line)), "")
        body = [line for line in lines[first:] if not line.startswith(("#", "%"))]
        text = "\n".join(body)
        if ";" in text or ("." not in text and ", " not in text and "," in text and len(body[0].split()) > 1):
            body = [line.replace(",", ".") for line in body]
        rows = np.array([[float(word) for word in re.split(r"[\s,;]+", line.strip(",; \t"))] for line in body])
    except (ValueError, OSError) as error:
        raise RecordingError(f"{path}: not {kind} ({cause(error)})") from error
    if not np.isfinite(rows).all():
        raise RecordingError(f"{path}: row {int(np.argmin(np.isfinite(rows).all(axis=1))) + 1} is not finite")
    if rows.size:
        rows[:, 0] *= seconds_in(float(np.median(rows[:, 0])))
    return rows, re.split(r"[\s]*[,;\t][\s]*|\s+(?!\[)", header.lstrip("#% "))


def load_tum(path: Path) -> Trajectory:
    """Reads `t x y z qx qy qz qw` rows; rows out of order are sorted, repeated times dropped.

    A header that names more columns, or w first, as EuRoC's, is followed. Raises
    `RecordingError` for a file that is unreadable, malformed, or has positions without orientation.
    """
    rows, names = read_rows(path, "a TUM trajectory")
    letters = "".join(name.partition("[")[0].strip()[-1:].lower() for name in names[4:8])
    order = {"wxyz": "wxyz", "xyzw": "xyzw"}.get(letters)
    if rows.ndim == 2 and rows.shape[1] > 8 and order is not None:
        rows = rows[:, :8]
    if rows.shape[1:] != (8,) or len(rows) < 2:
        raise RecordingError(f"{path}: a TUM trajectory has at least 2 rows of 8 numbers, found {rows.shape}")
    norms = np.linalg.norm(rows[:, 4:], axis=1)
    if (norms == 0).all():
        raise RecordingError(
            f"{path}: holds positions only (every quaternion is zero); poses with orientation are needed"
        )
    if (np.abs(norms - 1) > _QUATERNION_TOLERANCE).any():
        row = int(np.argmax(np.abs(norms - 1) > _QUATERNION_TOLERANCE)) + 1
        raise RecordingError(f"{path}: row {row} has a quaternion of length {norms[row - 1]:.3g}, not 1")
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    if len(rows) < 2:
        raise RecordingError(f"{path}: all rows carry the same time")
    return Trajectory(rows[:, 0], rows[:, 1:4], Rotation.from_quat(rows[:, 4:]), str(path), order)


MIN_CONTROL_ROWS = 10  # of a control within the recording
_MIN_CONTROL_EXTENT = 3.0  # m; less than a bore is wide, and no heading comes of it


@dataclass(frozen=True)
class Control:
    """Positions of one point of the carrier in a surveyed frame."""

    times: Float[np.ndarray, " n"]  # s, growing
    positions: Float[np.ndarray, "n 3"]  # m
    path: Path  # The file
    dropped: int  # Rows left out because their time was repeated


def load_control(path: Path) -> Control:
    """Reads TUM rows `t x y z …`; rows out of order are sorted, repeated times dropped, orientations ignored.

    Raises `RecordingError` for a file that is unreadable or malformed, has too few rows, or all at one place.
    """
    rows, _ = read_rows(path, "position control in TUM form")
    if rows.size and rows.shape[1] not in (4, 8):
        raise RecordingError(f"{path}: control has rows of 4 or 8 numbers (t x y z, TUM), found {rows.shape[1]}")
    unique = rows[np.unique(rows[:, 0], return_index=True)[1]] if rows.size else rows
    if len(unique) < MIN_CONTROL_ROWS:
        raise RecordingError(f"{path}: control needs {MIN_CONTROL_ROWS} rows at different times, found {len(unique)}")
    extent = float(np.linalg.norm(np.ptp(unique[:, 1:4], axis=0)))
    if extent < _MIN_CONTROL_EXTENT:
        raise RecordingError(
            f"{path}: all positions lie within {extent:.2f} m; "
            f"control must move {_MIN_CONTROL_EXTENT:g} m to fix a length"
        )
    return Control(unique[:, 0], unique[:, 1:4], path, len(rows) - len(unique))
