"""One sweep of a LiDAR."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Scan:
    """A sweep in the sensor frame.

    Attributes:
        stamp: Time of the sweep, s.
        points: Returns at their own time, m, `(n, 3)`.
        times: Time of each return after `stamp`, s, `(n,)`.
    """

    stamp: float
    points: Float[np.ndarray, "n 3"]
    times: Float[np.ndarray, " n"]
