"""Names what a cloud is in which no bore can be seen."""

import numpy as np
from jaxtyping import Float

from scene.cleaning.follow import Course
from scene.cleaning.seeds import Seed

_FLAT = 0.04  # of the longest extent
_OPEN = 0.6  # share of the unseen directions that lie above
_THIN, _LOW = 0.3, 2.0  # m, heights between which a cloud may be a culvert or a pipe
_NARROW = "no tunnel was found in the cloud: a bore under about 1.5 m is too narrow to be followed, "
_TALL = 1.2  # times the larger extent in plan


def name_cloud(points: Float[np.ndarray, "n 3"], seeds: list[Seed], course: Course | None, min_length: float) -> str:
    """Return the sentence that refuses a cloud.

    `course` is the longest bore that could be followed, shorter than `min_length`, m, or than it is wide.
    """
    centred = points - points.mean(axis=0)
    sample = centred[:: max(1, len(points) // 20_000)]
    plan = _principal(sample[:, :2])
    run, across = (_extent(sample[:, :2] @ axis) for axis in plan)
    height = _extent(sample[:, 2])
    thickness = float(np.ptp(np.percentile(sample @ _principal(sample)[2], [5, 95])))
    size = f"{run:.0f} m by {across:.0f} m in plan and {height:.0f} m high"
    if max(run, height) < min_length:
        return f"the tunnel is at most {run:.1f} m long; at least {min_length:g} m are needed"
    if across < _LOW and _THIN < height < _LOW:
        return _NARROW + size
    if thickness < _FLAT * max(run, across, height):
        return f"no tunnel in the cloud: its points lie on a plane, {size}"
    if height > max(_TALL * run, min_length):
        return f"no tunnel in the cloud: a vertical shaft, {size}"
    if run < min_length:
        return f"the tunnel is at most {run:.1f} m long; at least {min_length:g} m are needed"
    best = max(seeds, key=lambda seed: seed.enclosed, default=None)
    if best is not None and is_open_above(best.radius):
        return f"no tunnel in the cloud: open above, so a street or a cutting, {size}"
    if course is not None:
        return (
            f"a room, not a tunnel: {size}; the longest way enclosed by walls is {course.length:.0f} m long "
            f"and {course.width:.0f} m wide"
        )
    if _THIN < height < _LOW:
        return _NARROW + size
    return f"no tunnel in the cloud: no place in it is enclosed all around, {size}"


def _principal(centred: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "k k"]:
    """Unit vectors of the longest to the shortest extent."""
    return np.linalg.eigh(centred.T @ centred)[1].T[::-1]


def _extent(along: Float[np.ndarray, " n"]) -> float:
    return float(np.ptp(np.percentile(along, [0.5, 99.5])))


def is_open_above(radius: Float[np.ndarray, " rays"]) -> bool:
    """Return whether what is not seen of a section lies above, and is most of what is above."""
    turn = -np.pi + 2 * np.pi * (np.arange(len(radius)) + 0.5) / len(radius)
    unseen, above = ~np.isfinite(radius), np.sin(turn) > 0.7
    return bool(unseen[above].mean() > _OPEN and (np.sin(turn[unseen]) > 0).mean() > _OPEN)
