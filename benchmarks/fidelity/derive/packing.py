"""Cubes that points lie in, as single numbers."""

import numpy as np
from jaxtyping import Float, Int


def cells(points: Float[np.ndarray, "n 3"], edge: float) -> Int[np.ndarray, " n"]:
    """A whole number for the cube that each point lies in."""
    index = np.floor(points / edge).astype(np.int64) + (1 << 20)
    return (index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]
