"""How rough the wall is over half a metre, in the held-out recording and in the lining, by one estimator.

Medians over the planes: a mean hangs on the few planes that hold a pocket's edge or the foot of a wall, and on which of
them were drawn.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case, of_hold
from benchmarks.fidelity.derive import shell

_RADIUS = 0.25  # m; planes of 0.5 m
_LEAST = 20  # points on a plane
_MOST = 60
_PLANES = 1500
_FEWEST = 20
_STEP = 0.06  # m; a plane from which a point is further away holds a pocket or an edge
_UPRIGHT = 0.8  # |z| of a normal beyond which a plane is floor or crown
_MEDIAN_ERROR = 1.4826 * 1.2533  # times the median absolute deviation over root n: standard error of a median
_AT_ONCE = 100  # planes, whose pairs of points take 26 MB
_CLOSE = 0.05  # m; two returns so near to each other differ by their noise


@dataclass(frozen=True)
class Patches:
    """Smooth pieces of wall in the held-out recording.

    Attributes:
        beam: Numbers of the beams on each plane, `(planes, at most _MOST)`, -1 as padding.
        roughness: Variance about the planes, noise taken off, m²; may come out below 0 where there is hardly any.
        noise: Variance of the returns along the normals, m².
        resolved: Whether the roughness stands out of its own standard error.
    """

    beam: Int[np.ndarray, "p k"]
    roughness: float
    noise: float
    resolved: bool

    @property
    def planes(self) -> int:
        """How many."""
        return len(self.beam)


@of_hold
def of_reference(case: Case) -> Patches | None:
    """The held-out wall; `None` where its points lie too far apart."""
    assert case.hold is not None
    hold = case.hold
    index = np.flatnonzero(hold.returned)
    index = index[np.lexsort((hold.direction[index, 2], hold.time[index]))]  # the same planes in whatever order
    points = hold.origin[index] + hold.range[index, None] * hold.direction[index]
    points -= np.floor(points.mean(axis=0))
    tree = cKDTree(points)
    seeds = case.rng("tri_roughness_ratio").permutation(len(points))[: 4 * _PLANES]
    distance, near = tree.query(points[seeds], k=_MOST, distance_upper_bound=_RADIUS)
    inside = np.isfinite(distance)
    enough = inside.sum(axis=1) >= _LEAST
    near, inside = near[enough], inside[enough]
    if not len(near):
        return None
    place = points[np.where(inside, near, 0)]
    normal, away = _planes(place, inside)
    smooth = (np.abs(normal[:, 2]) < _UPRIGHT) & (np.where(inside, np.abs(away), 0.0).max(axis=1) < _STEP)
    smooth &= np.cumsum(smooth) <= _PLANES
    if smooth.sum() < _FEWEST:
        return None
    near, inside, normal, away = near[smooth], inside[smooth], normal[smooth], away[smooth]
    whole, noise = _spread(away, inside), _noise(points[np.where(inside, near, 0)], inside, normal, away)
    judged = np.isfinite(noise)
    if judged.sum() < _FEWEST:
        return None
    excess = (whole - noise)[judged]
    middle = float(np.median(excess))
    error = _MEDIAN_ERROR * float(np.median(np.abs(excess - middle))) / np.sqrt(len(excess))
    beam = np.where(inside, index[np.where(inside, near, 0)], -1)[judged]
    return Patches(beam, middle, float(np.median(noise[judged])), middle > 2.0 * error)


def of_lining(case: Case) -> float:
    """Variance of the lining about the same planes, sampled by the same beams, m²; `nan` without planes."""
    patches = of_reference(case)
    if patches is None:
        return float("nan")
    assert case.hold is not None
    beam = np.unique(patches.beam[patches.beam >= 0])
    origin, direction = case.hold.origin[beam] - shell.offset(case), case.hold.direction[beam]
    distance = np.full(len(case.hold.range), np.nan)
    distance[beam] = shell.first_hits(shell.lining(case), origin, direction)[1]
    # A beam that meets something else than the wall says nothing about its roughness.
    distance[np.abs(distance - case.hold.range) > 0.5] = np.nan
    reach = np.where(patches.beam >= 0, distance[patches.beam], np.nan)
    inside = np.isfinite(reach)
    full = inside.sum(axis=1) >= _LEAST
    patch, inside, reach = patches.beam[full], inside[full], reach[full]
    hit = case.hold.origin[patch] + np.nan_to_num(reach)[..., None] * case.hold.direction[patch]
    return float(np.median(_spread(_planes(hit - hit[:, :1], inside)[1], inside)))


def _planes(points: Float[np.ndarray, "p k 3"], inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal of the plane through each set of points, and their signed distances from it."""
    weight = inside[..., None] / inside.sum(axis=1)[:, None, None]
    centred = np.where(inside[..., None], points - (weight * points).sum(axis=1, keepdims=True), 0.0)
    normal = np.linalg.eigh(np.einsum("pki,pkj->pij", centred, centred))[1][..., 0]
    return normal, np.einsum("pki,pi->pk", centred, normal)


def _spread(away: Float[np.ndarray, "p k"], inside: np.ndarray) -> Float[np.ndarray, " p"]:
    """Variance about each plane, three degrees of freedom taken off, m²."""
    return (np.where(inside, away, 0.0) ** 2).sum(axis=1) / (inside.sum(axis=1) - 3)


def _noise(
    points: Float[np.ndarray, "p k 3"], inside: np.ndarray, normal: Float[np.ndarray, "p 3"], away: np.ndarray
) -> Float[np.ndarray, " p"]:
    """Variance of one return along the normal, from pairs close to each other in the plane, m²; `nan` without."""
    points = np.where(inside[..., None], points - points[:, :1], 1e3 * (1.0 + np.arange(points.shape[1]))[:, None])
    parts = [slice(start, start + _AT_ONCE) for start in range(0, len(points), _AT_ONCE)]
    return np.concatenate([_pair_noise(points[part], normal[part]) for part in parts])


def _pair_noise(points: Float[np.ndarray, "p k 3"], normal: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, " p"]:
    gap = points[:, :, None] - points[:, None]
    across = np.einsum("pkli,pi->pkl", gap, normal)
    pair = np.triu(np.sum(gap**2, axis=-1) - across**2 < _CLOSE**2, 1)
    with np.errstate(invalid="ignore"):
        return np.sum(pair * across**2, axis=(1, 2)) / (2.0 * pair.sum(axis=(1, 2)))
