"""An estimated trajectory beside the true one: read, brought to the same times, aligned."""

import dataclasses
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from benchmarks.slam.errors import SlamError
from scene.errors import RecordingError
from scene.poses.trajectory import Trajectory, load_tum

Alignment = Literal["origin", "se3", "none"]
ALIGNMENTS = ("origin", "se3", "none")
_SLACK = 1e-3  # s: a stamp so far outside the truth's span still counts as its end


@dataclasses.dataclass(frozen=True)
class Track:
    """Poses at the same times by an estimate and in truth.

    Attributes:
        time: s, growing, `(n,)`.
        position: Estimated, m, `(n, 3)`.
        rotation: Estimated, `n` of them.
        true_position: m, `(n, 3)`.
        true_rotation: `n` of them.
        covered: Share of the truth's duration between the first and the last of these times.
    """

    time: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "n 3"]
    rotation: Rotation
    true_position: Float[np.ndarray, "n 3"]
    true_rotation: Rotation
    covered: float

    @property
    def travelled(self) -> Float[np.ndarray, " n"]:
        """True distance driven since the first time, m."""
        steps = np.linalg.norm(np.diff(self.true_position, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


def read_track(estimate: Path, truth: Path, alignment: Alignment = "origin") -> Track:
    """Both files as one track: at the estimate's times, the truth interpolated, and the estimate aligned to it.

    Args:
        estimate: TUM file of a SLAM program.
        truth: TUM file of the recording's truth.
        alignment: See `aligned`.

    Raises:
        SlamError: A file is missing or wrong, the two share no two times, or there is no such alignment.
    """
    if alignment not in ALIGNMENTS:
        raise SlamError(f"no alignment {alignment!r}; there are {', '.join(ALIGNMENTS)}")
    try:
        found, true = load_tum(estimate), load_tum(truth)
    except RecordingError as error:
        raise SlamError(str(error)) from error
    return aligned(_paired(found, true), alignment)


def _paired(found: Trajectory, true: Trajectory) -> Track:
    begin, end = true.times[0], true.times[-1]
    some = np.flatnonzero((found.times >= begin - _SLACK) & (found.times <= end + _SLACK))
    if len(some) < 2:
        raise SlamError(
            f"{found.source}: shares {len(some)} of its {len(found.times)} times ({found.times[0]:.3f} to "
            f"{found.times[-1]:.3f} s) with {true.source} ({begin:.3f} to {end:.3f} s); at least 2 are needed"
        )
    time = found.times[some]
    position, rotation = true.at(time)
    covered = float((time[-1] - time[0]) / (end - begin))
    return Track(time, found.positions[some], found.rotations[some], position, rotation, min(covered, 1.0))


def aligned(track: Track, alignment: Alignment) -> Track:
    """The estimate moved as a whole: `origin` puts its first pose on the true one, `se3` all poses by least squares.

    A rigid motion only: a scale is never fitted, since along a tunnel the scale is what one wants to know. `none`
    leaves poses in the frame that they are in, for programs that localise in the given map.

    Source of `se3`: Umeyama 1991, Least-squares estimation of transformation parameters between two point patterns.
    """
    if alignment == "none":
        return track
    if alignment == "origin":
        turn = track.true_rotation[0] * track.rotation[0].inv()
        shift = track.true_position[0] - turn.apply(track.position[0])
    else:
        middle, true_middle = track.position.mean(axis=0), track.true_position.mean(axis=0)
        covariance = (track.true_position - true_middle).T @ (track.position - middle)
        left, _, right = np.linalg.svd(covariance)
        mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
        turn = Rotation.from_matrix(left @ mirror @ right)
        shift = true_middle - turn.apply(middle)
    return dataclasses.replace(track, position=turn.apply(track.position) + shift, rotation=turn * track.rotation)
