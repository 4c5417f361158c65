"""M3C2: the distance along the normal between held-out and synthetic cloud, and what of it is significant."""

import logging
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from benchmarks.fidelity.case import Case, derived
from benchmarks.fidelity.derive.beams import at, paired, returns
from benchmarks.fidelity.derive.noise import Planes, chosen, real_planes

CORES = 5000
RADIUS = 0.15  # m, of the cylinder
REACH = 0.5  # m along the normal, either way
REGISTRATION = 0.01  # m: what poses that are given to a centimetre leave between two clouds


@dataclass(frozen=True)
class Significance:
    """At each core point that has both clouds in its cylinder.

    Attributes:
        significant: 1 where |distance| exceeds the level of detection, else 0, `(n,)`.
        distance: Signed, m, `(n,)`.
        station: Along the sensor's path, m, `(n,)`.
    """

    significant: Float[np.ndarray, " n"]
    distance: Float[np.ndarray, " n"]
    station: Float[np.ndarray, " n"]


@derived
def significance(case: Case) -> Significance:
    """M3C2 of held-out points against the candidate's points on the same beams.

    The candidate's points carry no noise; the level of detection is 1.96·√(s₁²/n₁ + s₂²/n₂) + registration, in which
    the registration error is the given poses' (`REGISTRATION`).

    Source: Lague, Brodu, Leroux 2013, ISPRS J. Photogramm. 82; computed by py4dgeo.
    """
    import py4dgeo

    logging.getLogger("py4dgeo").setLevel(logging.WARNING)  # below that it writes a log into the working directory
    real, cast = returns(case), paired(case)
    hit = cast.hit
    flat: Planes = real_planes(case)
    pick = np.linspace(0, len(flat.point) - 1, min(len(flat.point), CORES)).astype(int)
    offset = np.round(real.points.mean(axis=0))
    clean = at(case, cast.range)[hit]
    m3c2 = py4dgeo.M3C2(
        epochs=(py4dgeo.Epoch(real.points - offset), py4dgeo.Epoch(clean - offset)),
        corepoints=flat.point[pick] - offset,
        corepoint_normals=flat.normal[pick],
        cyl_radius=RADIUS,
        max_distance=REACH,
        registration_error=REGISTRATION * case.tolerance,
    )
    distance, uncertainty = m3c2.run()
    known = np.isfinite(distance)
    beyond = np.abs(distance[known]) > uncertainty["lodetection"][known]
    return Significance(beyond.astype(float), distance[known], real.local[chosen(case)][pick][known, 0])
