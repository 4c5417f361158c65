"""The comparison that cannot fail: a cloud cast in the candidate with noise, against the same candidate."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.fidelity.case import Case, derived
from benchmarks.fidelity.derive.beams import paired, returns
from benchmarks.fidelity.derive.distances import thinned
from benchmarks.fidelity.derive.surface import nearest

SIGMA = 0.05  # m: the range noise that the paper states for its LiDAR
_MOST = 30_000


@dataclass(frozen=True)
class SelfCast:
    """Distances of a noisy cloud to the mesh that it was cast in.

    Attributes:
        distance: m, `(n,)`.
        noise_alone: σ·√(2/π)·mean|cos incidence|, m: the mean distance that noise gives on planes.
    """

    distance: Float[np.ndarray, " n"]
    noise_alone: float


@derived
def selfcast(case: Case) -> SelfCast:
    """At the held-out beams; logged only, since any mesh passes."""
    real, cast = returns(case), paired(case)
    pick = thinned(case)
    pick = pick[cast.hit[pick]]
    pick = pick[:: max(len(pick) // _MOST, 1)]
    reach = cast.range[pick] + SIGMA * case.rng("selfcast").standard_normal(len(pick))
    distance, _, _ = nearest(case).query(real.origin[pick] + reach[:, None] * real.direction[pick])
    return SelfCast(distance, float(SIGMA * np.sqrt(2.0 / np.pi) * np.mean(cast.cosine[pick])))
