"""The stretch of the sensor's path of which held-out returns tell, and bins along it."""

import numpy as np
from jaxtyping import Float, Int

from benchmarks.fidelity.case import Case, of_hold
from benchmarks.fidelity.derive.beams import returns

BIN = 10.0  # m


@of_hold
def extent(case: Case) -> tuple[float, float]:
    """Stations between which the held-out returns lie, but for one in a thousand at either end, m."""
    low, high = np.percentile(returns(case).local[:, 0], [0.1, 99.9])
    return float(low), float(high)


def bins(case: Case, station: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Equal bins of about `BIN` over `extent`; what lies beyond belongs to the first and the last."""
    low, high = extent(case)
    count = max(round((high - low) / BIN), 1)
    return np.clip(((station - low) / (high - low) * count).astype(int), 0, count - 1)
