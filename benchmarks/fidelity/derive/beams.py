"""Held-out beams and the same beams cast in the candidate."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from benchmarks.fidelity.case import Case, derived, of_hold, until
from benchmarks.fidelity.derive.path import sensor_path
from benchmarks.fidelity.derive.surface import intersector, normals

_NEAR = 1.0  # m over which the path's frame is taken as straight: less than a millimetre at a radius of 500 m


@dataclass(frozen=True)
class Returns:
    """Held-out beams that came back, in the order of time.

    Attributes:
        scan: Number of the scan, `(n,)`.
        origin: m, `(n, 3)`.
        direction: Unit vectors, `(n, 3)`.
        range: m, `(n,)`.
        points: m, `(n, 3)`.
        local: Station, left and up of the points along `sensor_path`, m, `(n, 3)`.
        heading: `direction` in the path's frame at the points, `(n, 3)`.
    """

    scan: Int[np.ndarray, " n"]
    origin: Float[np.ndarray, "n 3"]
    direction: Float[np.ndarray, "n 3"]
    range: Float[np.ndarray, " n"]
    points: Float[np.ndarray, "n 3"]
    local: Float[np.ndarray, "n 3"]
    heading: Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class Paired:
    """`Returns` cast in the candidate.

    Attributes:
        range: m; `inf` where the beam leaves the candidate, `(n,)`.
        face: Of `surface`; -1 where nothing is hit, `(n,)`.
        cosine: Of the angle between beam and face normal, 0 to 1, 0 where nothing is hit, `(n,)`.
        difference: Range in the candidate less range measured, m, `(n,)`.
    """

    range: Float[np.ndarray, " n"]
    face: Int[np.ndarray, " n"]
    cosine: Float[np.ndarray, " n"]
    difference: Float[np.ndarray, " n"]

    @property
    def hit(self) -> Bool[np.ndarray, " n"]:
        """Whether the beam meets the candidate."""
        return self.face >= 0


@of_hold
def returns(case: Case) -> Returns:
    """The held-out returns, sorted so that the order in the file does not matter."""
    hold = case.hold
    assert hold is not None
    order = np.lexsort((hold.direction[:, 2], hold.time))
    order = order[hold.returned[order]]
    direction, path = hold.direction[order], sensor_path(case)
    points = hold.origin[order] + hold.range[order, None] * direction
    local = path.local(points)
    axes = path.frames(local[:, 0])[1:]
    heading = np.stack([np.einsum("ij,ij->i", direction, axis) for axis in axes], axis=1)
    return Returns(hold.scan[order], hold.origin[order], direction, hold.range[order], points, local, heading)


@until("LIN")
@derived
def paired(case: Case) -> Paired:
    """Every held-out return's beam, cast in everything visible of the candidate."""
    real, rays = returns(case), intersector(case)
    reach, face = rays.first(real.origin, real.direction)
    cosine = np.zeros(len(face))
    hit = face >= 0
    normal = normals(rays.mesh, face[hit])
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
    cosine[hit] = np.abs(np.einsum("ij,ij->i", normal, real.direction[hit])) / length
    return Paired(reach, face, np.minimum(cosine, 1.0), reach - real.range)


def at(case: Case, reach: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Points on the held-out beams at other ranges, m; not a number where the range is not finite."""
    real = returns(case)
    return real.origin + np.where(np.isfinite(reach), reach, np.nan)[:, None] * real.direction


def local_at(case: Case, reach: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """The same in station, left and up along the sensor's path."""
    real = returns(case)
    shift = np.where(np.isfinite(reach), reach, np.nan) - real.range
    local = real.local + shift[:, None] * real.heading
    far = np.abs(shift) > _NEAR
    local[far] = sensor_path(case).local(real.points[far] + shift[far, None] * real.direction[far])
    return local


@until("OCC")
@derived
def _draws(case: Case) -> dict[str, Float[np.ndarray, " n"]]:
    return {}


def noisy(case: Case, draw: str) -> Float[np.ndarray, " n"]:
    """Ranges that the sensor would have measured in the candidate, m; `inf` where a beam leaves it.

    Args:
        case: With a held-out recording, whose data sheet gives the noise.
        draw: Name of the draw; the same name gives the same noise.
    """
    assert case.hold is not None
    if draw not in _draws(case):
        noise = case.rng(f"range noise {draw}").standard_normal(len(paired(case).range))
        _draws(case)[draw] = paired(case).range + case.hold.sigma * noise
    return _draws(case)[draw]


@derived
def synthetic(case: Case) -> Float[np.ndarray, "n 3"]:
    """Noisy points of the paired beams, m, `(n, 3)`; not a number where a beam leaves the candidate."""
    return at(case, noisy(case, "first"))
