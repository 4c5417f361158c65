"""What held-out beams say of the air: points that they passed and points where they ended, about the reference axis."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from benchmarks.fidelity.case import Case, of_hold
from benchmarks.fidelity.derive.beams import returns
from benchmarks.fidelity.derive.curve import Curve

_PER_METRE = 300  # beams followed for each metre of chainage
_STEP = 0.15  # m
_FARTHEST = 25.0  # m
MARGIN = 0.20  # m before the return where a beam's air ends


@dataclass(frozen=True)
class Carved:
    """Samples along beams.

    Attributes:
        passed: Points that beams went through, tunnel frame, m, `(k, 3)`.
        beam: Which beam passed each, `(k,)`.
        ended: Returns of the same beams, m, `(b, 3)`.
    """

    passed: Float[np.ndarray, "k 3"]
    beam: Int[np.ndarray, " k"]
    ended: Float[np.ndarray, "b 3"]


@of_hold
def carved(case: Case) -> Carved:
    """Every 15 cm of about 300 beams a metre, from the sensor to 20 cm before the return or 25 m."""
    real = returns(case)
    length = np.linalg.norm(np.ptp(real.origin, axis=0)) + 10.0
    back = np.arange(0, len(real.range), max(1, int(len(real.range) / (_PER_METRE * length))))
    origin, direction = real.origin[back], real.direction[back]
    reach = np.minimum(real.range[back] - MARGIN, _FARTHEST)
    count = np.maximum((reach / _STEP).astype(int), 0)
    beam = np.repeat(np.arange(len(back)), count)
    place = np.arange(len(beam)) - np.repeat(np.cumsum(count) - count, count)
    along = (place + 0.5) * _STEP
    passed = origin[beam] + along[:, None] * direction[beam]
    return Carved(passed, beam, real.points[back])


def about(case: Case, curve: Curve) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "b 3"]]:
    """Passed and ended points as station, left and up about a curve; remembered."""
    assert case.hold is not None
    key = ("carving.about", id(curve))
    if key not in case.hold.cache:
        found = carved(case)
        case.hold.cache[key] = (curve, curve.local(found.passed), curve.local(found.ended))
    return case.hold.cache[key][1:]
