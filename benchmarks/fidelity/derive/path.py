"""The way that the held-out sensor went: coordinates in which no candidate has a say."""

import numpy as np
from jaxtyping import Float
from scipy.signal import savgol_filter

from benchmarks.fidelity.case import Case, of_hold
from benchmarks.fidelity.derive.curve import Curve

STEP = 1.0  # m between nodes
_WINDOW = 11  # nodes over which the sway of the carrier is smoothed away


@of_hold
def sensor_path(case: Case) -> Curve:
    """Smoothed sensor positions of the held-out recording, straight on beyond both ends.

    The positions are strung by nearness, not by time: a way back adds nothing, and poses in a wrong order leave the
    path where it is.

    Raises:
        ValueError: The sensor passed fewer than four positions `STEP` apart.
    """
    hold = case.hold
    assert hold is not None
    order = np.argsort(hold.time, kind="stable")
    _, first = np.unique(hold.scan[order], return_index=True)
    nodes: list[np.ndarray] = []
    for position in hold.origin[order[first]]:
        if not nodes or np.linalg.norm(np.asarray(nodes) - position, axis=1).min() >= 0.9 * STEP:
            nodes.append(position)
    if len(nodes) < 4:
        raise ValueError(f"the held-out sensor passed {len(nodes)} positions {STEP} m apart; 4 are needed")
    strung = _strung(np.asarray(nodes))
    window = min(_WINDOW, len(nodes) - (len(nodes) + 1) % 2)
    smooth = savgol_filter(strung, window, min(2, window - 1), axis=0, mode="interp")
    station = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))])
    return Curve(station, smooth)


def _strung(nodes: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Positions in order from the end that is nearer to the first of them: always on to the nearest one left."""
    far = nodes[np.argmax(np.linalg.norm(nodes - nodes.mean(axis=0), axis=1))]
    other = nodes[np.argmax(np.linalg.norm(nodes - far, axis=1))]
    here = min((far, other), key=lambda end: float(np.linalg.norm(end - nodes[0])))
    left, order = np.ones(len(nodes), bool), []
    for _ in nodes:
        order.append(int(np.argmin(np.where(left, np.sum((nodes - here) ** 2, axis=1), np.inf))))
        left[order[-1]] = False
        here = nodes[order[-1]]
    return nodes[order]


def mouths(case: Case) -> tuple[float, float]:
    """Stations of the candidate's two ends on the sensor's path, m, the smaller one first."""
    ends = sensor_path(case).local(case.candidate.bore.position[[0, -1]])[:, 0]
    return float(ends.min()), float(ends.max())
