"""The floor of one section: a line under sleepers, rails and people, and the lowest flat surface below it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

# What lies a little above the line may be track or clutter; what lies below is noise.
_GATES = ((-0.15, 0.10), (-0.08, 0.05), (-0.05, 0.04), (-0.04, 0.04))
_START_PERCENTILE = 20
_CLUTTER = 0.45
_MIN_POINTS = 30
_FLAT_SHARE = 0.85
_INNER = 0.75
_BESIDE = 0.5


def fit_floor_line(lateral: Float[np.ndarray, " n"], upward: Float[np.ndarray, " n"]) -> tuple[float, float] | None:
    """Fits `(a, b)` of the floor `upward = a + b · lateral` to one section, m; `None` where the bottom is not flat."""
    if len(lateral) < _MIN_POINTS:
        return None
    half_width = np.percentile(np.abs(lateral), 95)
    bottom = (upward < 0) & (np.abs(lateral) < _INNER * half_width)
    y, z = lateral[bottom], upward[bottom]
    if len(y) < _MIN_POINTS:
        return None
    line = (float(np.percentile(z, _START_PERCENTILE)), 0.0)
    for below, above in _GATES:
        residual = z - line[0] - line[1] * y
        keep = (residual > below) & (residual < above)
        if keep.sum() < _MIN_POINTS or np.ptp(y[keep]) < half_width:
            return None
        line = _fit_through(y[keep], z[keep])
    line, keep = _settle(line, y, z, half_width)
    beside = keep & (np.abs(y) > _BESIDE * half_width)
    if min((beside & (y > 0)).sum(), (beside & (y < 0)).sum()) >= _MIN_POINTS:
        line = _fit_through(y[beside], z[beside])  # beside the track, where no sleeper lifts it
    residual = z - line[0] - line[1] * y
    explained = (np.abs(residual) < 0.06) | ((residual > 0) & (residual < _CLUTTER))
    support = (np.abs(residual) < 0.06).mean()
    return line if explained.mean() > _FLAT_SHARE and support > 0.3 else None


_PEAK = (-0.08, 0.08)  # m about a line, in which the height is sought that most points have
_PEAK_BIN, _PEAK_HALF = 0.01, 0.025  # m


def _settle(
    line: tuple[float, float], y: np.ndarray, z: np.ndarray, half_width: float
) -> tuple[tuple[float, float], Bool[np.ndarray, " n"]]:
    """Moves a line to the height that most points near it have: sleepers 6 cm proud would lift it by 1 to 3 cm.

    Returns the line, and the points on it.
    """
    residual = z - line[0] - line[1] * y
    count, edges = np.histogram(residual, np.arange(_PEAK[0], _PEAK[1] + _PEAK_BIN / 2, _PEAK_BIN))
    peak = float(edges[int(np.convolve(count, np.ones(3), mode="same").argmax())]) + _PEAK_BIN / 2
    keep = np.abs(residual - peak) < _PEAK_HALF
    if keep.sum() < _MIN_POINTS or np.ptp(y[keep]) < half_width:
        return line, np.abs(residual) < -_GATES[-1][0]
    return _fit_through(y[keep], z[keep]), keep


_STRIPS = 24  # that the width between the walls is divided into
_OUT = 0.97  # of the half width
_LAYER = 0.02  # m
_SLOPES = np.linspace(-0.06, 0.06, 7)
_LEAST_SHARE = 0.1  # of the returns of a strip of floor, in a strip that shows it
_LEAST_EXTENT, _MOST_DEEPER = 0.15, 0.2  # of the strips, shown on the floor and below it: a drain is narrower
_BESIDE_PLATFORM, _FLOOR_BESIDE = 0.6, 0.35  # of the strips, near the floor and on it, where a platform stands on it
_LOWER = 0.05  # m
_NEAR = 0.04  # m


def find_lower_line(
    lateral: Float[np.ndarray, " n"], upward: Float[np.ndarray, " n"], above: tuple[float, float] | None
) -> tuple[float, float] | None:
    """Finds the lowest flat surface of one section, under a line that `fit_floor_line` found, if it found one.

    Sleepers and ballast may hide most of a floor, and ghosts of people return more than it does. What tells it is how
    much of the width it is seen on, whatever the number of returns, with nothing flat below. Returns `(a, b)` as
    `fit_floor_line`; `None` where there is no such surface.
    """
    half_width = np.percentile(np.abs(lateral), 95) if len(lateral) >= _MIN_POINTS else 0.0
    low = (upward < 0) & (np.abs(lateral) < _OUT * half_width)
    y, z = lateral[low], upward[low]
    if len(y) < _MIN_POINTS:
        return None
    strip = np.minimum(((y / (_OUT * half_width) + 1) * _STRIPS / 2).astype(np.intp), _STRIPS - 1)
    layer = max((_best_layer(y, z, strip, float(slope)) for slope in _SLOPES), key=lambda layer: layer.worth)
    highest = np.inf if above is None else above[0] - _LOWER
    if layer.worth <= 0.0 or layer.line[0] > highest:
        return None
    line = _refine_line(layer.line, y, z, half_width, 0.0 if above is None else above[1])
    inner = layer.bottoms[np.abs(np.arange(_STRIPS) - (_STRIPS - 1) / 2) < _INNER * _STRIPS / 2]
    clutter = float(((inner > -0.06) & (inner < _CLUTTER)).mean())
    flat = clutter > _FLAT_SHARE or (clutter > _BESIDE_PLATFORM and layer.extent > _FLOOR_BESIDE)
    return line if flat and line is not None and line[0] < highest else None


@dataclass(frozen=True)
class _Layer:
    """A layer of returns that may be the floor of a section."""

    worth: float  # Score among the layers of all slopes; 0 where it is no floor.
    line: tuple[float, float]  # Height at the axis (m) and slope.
    extent: float  # Share of the strips whose lowest returns lie in it.
    # Height of each strip's lowest returns above it, m; `inf` where a strip shows nothing.
    bottoms: Float[np.ndarray, " strips"]


def _best_layer(
    y: Float[np.ndarray, " n"], z: Float[np.ndarray, " n"], strip: Int[np.ndarray, " n"], slope: float
) -> _Layer:
    """Return the layer of a slope that is the lowest on most of the width."""
    layer = np.floor((z - slope * y) / _LAYER).astype(np.intp)
    first = layer.min()
    layers = max(int(layer.max() - first) + 1, 8)
    count = np.bincount(strip * layers + layer - first, minlength=_STRIPS * layers).reshape(_STRIPS, layers)
    thick = count.copy()  # three layers
    thick[:, 1:] += count[:, :-1]
    thick[:, :-1] += count[:, 1:]
    shown = thick >= max(2.0, _LEAST_SHARE * float(np.median(thick.max(axis=1))))
    bottom = np.where(shown.any(axis=1), np.argmax(shown, axis=1), layers)
    lowest = np.bincount(bottom, minlength=layers + 1)[:layers] / _STRIPS
    extent = np.convolve(lowest, np.ones(3), mode="same")
    total = np.concatenate([np.zeros(3), np.cumsum(lowest), np.full(4, lowest.sum())])
    deeper, close = total[:layers], total[7:] - total[4:-3]  # more than 5 cm below; 3 to 9 cm above
    worth = extent - 3 * deeper - close - abs(slope)
    worth[(extent < _LEAST_EXTENT) | (deeper > _MOST_DEEPER)] = 0.0
    best = int(np.argmax(worth))
    line = ((first + best + 1.5) * _LAYER, slope)
    bottoms = np.where(bottom < layers, (bottom - best) * _LAYER, np.inf)
    return _Layer(float(worth[best]), line, float(extent[best]), bottoms)


def _refine_line(
    line: tuple[float, float], y: np.ndarray, z: np.ndarray, half_width: float, slope: float
) -> tuple[float, float] | None:
    """Fit a line to the returns near it; `slope` is that of a surface seen in the middle alone. `None`: too few."""
    for _ in range(3):
        keep = np.abs(z - line[0] - line[1] * y) < _NEAR
        if keep.sum() < _MIN_POINTS // 2:
            return None
        if np.ptp(y[keep]) > half_width:
            line = _fit_through(y[keep], z[keep])
        else:  # as between two tracks
            line = (float(np.mean(z[keep] - slope * y[keep])), slope)
    return line


def _fit_through(y: np.ndarray, z: np.ndarray) -> tuple[float, float]:
    slope, height = np.polyfit(y, z, 1)
    return float(height), float(slope)


def floor_radius(line: tuple[float, float], angle: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Return the distance from the axis to the floor in each direction, m; `inf` where it is not met."""
    descent = np.sin(angle) - line[1] * np.cos(angle)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = line[0] / descent
    return np.where((distance > 0) & np.isfinite(distance), distance, np.inf)
