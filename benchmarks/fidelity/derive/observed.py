"""Cells of the candidate's surface that held-out beams hit or pass through."""

import numpy as np
from jaxtyping import Bool

from benchmarks.fidelity.case import Case, derived
from benchmarks.fidelity.derive.beams import local_at, paired
from benchmarks.fidelity.derive.distances import STEEPEST
from benchmarks.fidelity.derive.packing import cells

_CELL = 0.1  # m
_EARLY = 0.15  # m


@derived
def phantom(case: Case) -> Bool[np.ndarray, " c"]:
    """For each cell of observable candidate surface, whether most beams that hit it came back from behind it.

    Cells of 10 cm stand for equal areas; beams at more than 80° of incidence do not count, for there a millimetre off
    the surface is centimetres along the beam. A beam passes through if its return lies over 15 cm behind the surface.
    """
    cast = paired(case)
    seen = cast.cosine > STEEPEST
    _, cell = np.unique(cells(local_at(case, cast.range)[seen], _CELL), return_inverse=True)
    crossed = np.bincount(cell, cast.difference[seen] < -_EARLY * case.tolerance)
    return crossed > 0.5 * np.bincount(cell)
