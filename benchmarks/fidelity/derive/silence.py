"""Beams that came back with nothing, and those that the candidate lets expect to."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from benchmarks.fidelity.case import Case, derived
from benchmarks.fidelity.derive.surface import intersector, normals


@dataclass(frozen=True)
class Silence:
    """Of every beam, returned or not.

    Attributes:
        silent: Nothing came back, `(n,)`.
        expected_silent: Cast in the candidate it meets nothing within reach, `(n,)`.
    """

    silent: Bool[np.ndarray, " n"]
    expected_silent: Bool[np.ndarray, " n"]


@derived
def silence(case: Case) -> Silence:
    """Real and expected beams without a return.

    A beam is expected back if it meets the candidate within the sensor's reach and its echo, cos(incidence) over the
    squared distance, is not too weak. No data sheet says how weak: the cut is the one number that the recording sets,
    where beams with a weaker echo in the candidate were more often silent than not.
    """
    hold = case.hold
    assert hold is not None
    rays = intersector(case)
    reach, face = rays.first(hold.origin, hold.direction)
    met = np.flatnonzero((face >= 0) & (reach <= hold.range_max))
    normal = normals(rays.mesh, face[met])
    cosine = np.abs(np.einsum("ij,ij->i", normal, hold.direction[met]))
    cosine /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
    order = np.argsort(cosine / np.maximum(reach[met], 0.1) ** 2, kind="stable")
    balance = np.concatenate([[0], np.cumsum(np.where(hold.returned[met[order]], -1, 1))])
    expected_silent = np.ones(len(reach), bool)
    expected_silent[met[order[int(np.argmax(balance)) :]]] = False
    return Silence(~hold.returned, expected_silent)
