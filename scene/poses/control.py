"""Position-only control: where a total station saw a prism, at about 3 Hz, without attitude."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from scene.errors import RecordingError
from scene.poses.trajectory import read_rows

_MIN_ROWS = 10
_MIN_EXTENT = 3.0  # m; less than a bore is wide, and no heading comes of it
MIN_SHARE = 0.5  # of the recording's time


@dataclass(frozen=True)
class Control:
    """Positions of one point of the carrier in a surveyed frame.

    Attributes:
        times: s, growing, `(n,)`.
        positions: m, `(n, 3)`.
        path: The file.
        dropped: Rows left out because their time was repeated.
    """

    times: Float[np.ndarray, " n"]
    positions: Float[np.ndarray, "n 3"]
    path: Path
    dropped: int

    def require_overlap(self, start: float, end: float, recording: Path) -> None:
        """Refuses control that misses much of the recording.

        Args:
            start: Of the recording, s.
            end: Of the recording, s.
            recording: For the message.

        Raises:
            RecordingError: Less than half of the recording's time lies between the first and the last row.
        """
        first, last = float(self.times[0]), float(self.times[-1])
        shared = max(min(end, last) - max(start, first), 0.0)
        if shared < MIN_SHARE * (end - start):
            raise RecordingError(
                f"{self.path}: control runs from {first:.2f} to {last:.2f} s, but {recording} from {start:.2f} to "
                f"{end:.2f} s; they share {shared:.1f} s, and {MIN_SHARE:.0%} of the recording is needed"
            )


def load_control(path: Path) -> Control:
    """Reads TUM rows `t x y z …`; rows out of order are sorted, repeated times dropped, orientations ignored.

    Raises:
        RecordingError: Unreadable, malformed, too few rows, or all at one place.
    """
    rows = read_rows(path, "position control in TUM form")
    if rows.size and rows.shape[1] not in (4, 8):
        raise RecordingError(f"{path}: control has rows of 4 or 8 numbers (t x y z, TUM), found {rows.shape[1]}")
    if rows.size and not np.isfinite(rows).all():
        raise RecordingError(f"{path}: row {int(np.argmin(np.isfinite(rows).all(axis=1))) + 1} is not finite")
    kept = rows[np.unique(rows[:, 0], return_index=True)[1]] if rows.size else rows
    if len(kept) < _MIN_ROWS:
        raise RecordingError(f"{path}: control needs {_MIN_ROWS} rows at different times, found {len(kept)}")
    extent = float(np.linalg.norm(np.ptp(kept[:, 1:4], axis=0)))
    if extent < _MIN_EXTENT:
        raise RecordingError(
            f"{path}: all positions lie within {extent:.2f} m; control must move {_MIN_EXTENT:g} m to fix a length"
        )
    return Control(kept[:, 0], kept[:, 1:4], path, len(rows) - len(kept))
