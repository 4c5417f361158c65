"""Errors of a trajectory: absolute and relative, as `evo` defines them, and resolved along the tunnel and across."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from benchmarks.slam.tracks import Track


@dataclasses.dataclass(frozen=True)
class Spread:
    """Statistics of errors that are not negative; `std` is about the mean, as evo has it."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @classmethod
    def of(cls, errors: Float[np.ndarray, " n"]) -> "Spread":
        """Of at least one error."""
        rmse = float(np.sqrt(np.mean(errors**2)))
        rest = (np.mean(errors), np.median(errors), np.std(errors), np.min(errors), np.max(errors))
        return cls(rmse, *(float(value) for value in rest))


def absolute(track: Track) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Error of each position (estimate less truth, m, fixed frame) and of each orientation (rad)."""
    turn = track.true_rotation.inv() * track.rotation
    return track.position - track.true_position, turn.magnitude()


def pairs_by_distance(track: Track, delta: float) -> Int[np.ndarray, "k 2"]:
    """Consecutive pieces of the true path, each ended by the first pose at least `delta` m on.

    Source: evo's RPE with `pairs_from_reference` and without `all_pairs`.
    """
    ends, since = [0], 0.0
    for k, step in enumerate(np.linalg.norm(np.diff(track.true_position, axis=0), axis=1), start=1):
        since += float(step)
        if since >= delta:
            ends.append(k)
            since = 0.0
    return np.column_stack([ends[:-1], ends[1:]])


def relative(track: Track, pairs: Int[np.ndarray, "k 2"]) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Error of each piece's motion, seen from the pose where it begins.

    Args:
        track: The track.
        pairs: Rows of first and last pose.

    Returns:
        Estimated less true displacement, turned into the fixed frame by the true attitude (m), and error of the turn
        (rad). Lengths are those of evo's relative error.
    """
    first, last = pairs.T
    moved = track.rotation[first].inv().apply(track.position[last] - track.position[first])
    truly = track.true_position[last] - track.true_position[first]
    turned = track.rotation[first].inv() * track.rotation[last]
    truth = track.true_rotation[first].inv() * track.true_rotation[last]
    return track.true_rotation[first].apply(moved) - truly, (truth.inv() * turned).magnitude()


def rms(values: Float[np.ndarray, " n"]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))
