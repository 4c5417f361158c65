"""The density-aware Chamfer distance."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.beams import local_at, paired, returns
from benchmarks.fidelity.derive.packing import cells

ALPHA = 40.0  # 1/m
_THIN = 0.1  # m


def density_aware_chamfer(case: Case) -> float:
    """Between held-out points and the candidate's points on the same beams, each thinned to one in 10 cm; 0 to 1.

    Source: Wu et al. 2021, arXiv 2111.12702, eq. 6: ½ Σ over both of the mean of 1 - exp(-α d) / n, with n the
    number of points that share the nearest neighbour.
    """
    edge, hit = _THIN * case.tolerance, paired(case).hit
    clouds = [
        points[np.unique(cells(points, edge), return_index=True)[1]]
        for points in (returns(case).local, local_at(case, paired(case).range)[hit])
    ]
    return 0.5 * (_one_way(clouds[0], clouds[1]) + _one_way(clouds[1], clouds[0]))


def _one_way(points: Float[np.ndarray, "n 3"], others: Float[np.ndarray, "m 3"]) -> float:
    distance, index = cKDTree(others).query(points)
    shared = np.bincount(index, minlength=len(others))[index]
    return float(np.mean(1.0 - np.exp(-ALPHA * distance) / shared))
