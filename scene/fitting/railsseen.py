"""Rails where the cloud shows them: their height, their gauge and where they lie under the axis."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

_RAIL_BAND = (0.60, 0.95)  # from the axis, m
_RAIL_LOW, _RAIL_HIGH = 0.12, 0.40  # above the bed, m
_HEAD_LAYER = 0.02  # above and below the most frequent height, m
_FACE = (0.012, 0.045)  # below the top of the head, m; gauge is measured 14 to 16 mm below it
_FACE_BAND = (0.66, 0.80)  # from the axis, m
_FACE_BLUR = 0.003  # m
_SWAY_BLOCK = 1.0  # m
_MIN_RAIL = 0.5  # share of the metres along which a rail must be seen
_MIN_SEEN = 10  # returns a metre


@dataclass(frozen=True)
class SeenRails:
    """Both rails.

    Attributes:
        gauge: Between the inner faces of the heads, 12 to 45 mm below their tops, m.
        centre: Of the track to the left of the axis, m.
        top: Above the bed, m.
    """

    gauge: float
    centre: float
    top: float


def find_rails(station: np.ndarray, lateral: np.ndarray, height: np.ndarray) -> SeenRails | None:
    """The rails among the points low in a bore; `None` where they are seen along too little of it.

    Args:
        station: Of each point, m.
        lateral: To the left of the axis, m.
        height: Above the bed, m.
    """
    heads = [_head(station, side * lateral, height) for side in (1, -1)]
    left, right = heads
    if left is None or right is None:
        return None
    sway = _sway(station, lateral, left, right)
    tops = [float(np.median(height[head])) for head in heads]
    faces = [_inner_face(side * (lateral - sway), height - top) for side, top in zip((1, -1), tops, strict=True)]
    return SeenRails(faces[0] + faces[1], (faces[0] - faces[1]) / 2, float(np.mean(tops)))


def _head(station: np.ndarray, across: np.ndarray, height: np.ndarray) -> Bool[np.ndarray, " n"] | None:
    """Returns on the top of one rail; `None` where it is seen along too little of the bore."""
    band = (across > _RAIL_BAND[0]) & (across < _RAIL_BAND[1]) & (height > _RAIL_LOW) & (height < _RAIL_HIGH)
    if len(np.unique(station[band].astype(int))) < _MIN_RAIL * max(np.ptp(station), 1.0):
        return None
    return band & (np.abs(height - _mode(height[band])) < _HEAD_LAYER)


def _sway(station: np.ndarray, lateral: np.ndarray, left: np.ndarray, right: np.ndarray) -> Float[np.ndarray, " n"]:
    """How far the track lies to the left of its mean place under the axis, metre by metre, m.

    Both rails sway together: the axis follows the walls, and poses are a centimetre off here and there. Unless it is
    taken out it blurs the edges of the heads.
    """
    block = (station / _SWAY_BLOCK).astype(np.intp)
    blocks = int(block.max()) + 1
    middles = np.full((2, blocks), np.nan)
    for k, head in enumerate((left, right)):
        order = np.argsort(block[head], kind="stable")
        at, bounds = lateral[head][order], np.searchsorted(block[head][order], np.arange(blocks + 1))
        for i in range(blocks):
            if bounds[i + 1] - bounds[i] >= _MIN_SEEN:
                middles[k, i] = np.median(at[bounds[i] : bounds[i + 1]])
    middle = middles.mean(axis=0)
    known = np.isfinite(middle)
    if known.sum() < 2:
        return np.zeros(len(station))
    at = (np.flatnonzero(known) + 0.5) * _SWAY_BLOCK
    return np.interp(station, at, middle[known] - np.median(middle[known]))


def _mode(height: np.ndarray) -> float:
    count, edges = np.histogram(height, np.arange(_RAIL_LOW, _RAIL_HIGH, 0.004))
    return float(edges[np.convolve(count, np.ones(3), mode="same").argmax()] + 0.002)


def _inner_face(across: np.ndarray, below: np.ndarray) -> float:
    """Where most returns from the side of the head lie, m.

    The side, not the edge of the top: poses that are a little off blur both, and a blurred edge moves outwards, while a
    blurred face stays where it is.
    """
    step = 0.001
    side = (below < -_FACE[0]) & (below > -_FACE[1])
    count, edges = np.histogram(across[side], np.arange(*_FACE_BAND, step))
    smooth = gaussian_filter1d(count.astype(float), _FACE_BLUR / step)
    k = int(np.clip(smooth.argmax(), 1, len(smooth) - 2))
    bend = 2 * (smooth[k - 1] - 2 * smooth[k] + smooth[k + 1])
    return float(edges[k] + step / 2 + (step * (smooth[k - 1] - smooth[k + 1]) / bend if bend else 0.0))
