"""The floor of a section: a straight line under sleepers, rails and people, where there is one."""

import numpy as np
from jaxtyping import Float

# What lies a little above the line may be track or clutter; what lies below is noise.
_GATES = ((-0.15, 0.10), (-0.08, 0.05), (-0.05, 0.04), (-0.04, 0.04))
_START_PERCENTILE = 20
_CLUTTER = 0.45
_MIN_POINTS = 30
_FLAT_SHARE = 0.85
_INNER = 0.75
_BESIDE = 0.5


def fit_line(lateral: Float[np.ndarray, " n"], upward: Float[np.ndarray, " n"]) -> tuple[float, float] | None:
    """Height on the axis (m) and slope of the floor of one section, or `None` where the bottom is not flat.

    Args:
        lateral: Points of the section about the axis, m.
        upward: The same.

    Returns:
        `(a, b)` of `upward = a + b · lateral`.
    """
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
        line = _through(y[keep], z[keep])
    beside = keep & (np.abs(y) > _BESIDE * half_width)
    if min((beside & (y > 0)).sum(), (beside & (y < 0)).sum()) >= _MIN_POINTS:
        line = _through(y[beside], z[beside])  # beside the track, where no sleeper lifts it
    residual = z - line[0] - line[1] * y
    explained = (np.abs(residual) < 0.06) | ((residual > 0) & (residual < _CLUTTER))
    support = (np.abs(residual) < 0.06).mean()
    return line if explained.mean() > _FLAT_SHARE and support > 0.3 else None


def _through(y: np.ndarray, z: np.ndarray) -> tuple[float, float]:
    slope, height = np.polyfit(y, z, 1)
    return float(height), float(slope)


def radius(line: tuple[float, float], angle: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Distance from the axis to the floor line in each direction, m; `inf` where it is not met."""
    descent = np.sin(angle) - line[1] * np.cos(angle)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = line[0] / descent
    return np.where((distance > 0) & np.isfinite(distance), distance, np.inf)
