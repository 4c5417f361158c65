"""When each return of a sweep was measured: drivers differ in unit, sign and origin, and none of them says so.

Relative values only need their unit: the return's time is the stamp plus the value, whether the stamp is of the end of
the sweep (VLP-16, values mostly negative) or of its start (Ouster, Livox). Absolute ones (Hesai, RoboSense) are matched
with the stamp.
"""

import numpy as np
from jaxtyping import Float, Shaped

from scene.reading.scan import Scan

FIELDS = ("t", "time", "offset_time", "timestamp", "time_stamp", "timestamps", "ts")
STATIC = "none: every sweep is taken as static"
_UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns"))
_LONGEST_SWEEP = 2.0  # s
_SAME_CLOCK = 10.0  # s between stamp and absolute point times
_FIRST_EPOCH = 1e8  # s; absolute times count from 1970, and nothing older than 1973 is a recording


def make_scan(
    stamp: float, points: Float[np.ndarray, "n 3"], values: Shaped[np.ndarray, " n"] | None, name: str = ""
) -> tuple[Scan, str]:
    """A sweep with its returns in the order of time, and the convention its point times follow.

    Returns at the origin (nothing came back) and those that are not finite, in place or time, are dropped.

    Args:
        stamp: Of the message, s.
        points: m.
        values: Point times as stored; `None` where there are none.
        name: Their field.

    Raises:
        ValueError: The point times span more than a sweep can last.
    """
    good = np.isfinite(points).all(axis=1) & (points != 0).any(axis=1)
    if values is None:
        return Scan(stamp, points[good], np.zeros(int(good.sum()))), STATIC
    raw = values.astype(np.float64)
    good &= np.isfinite(raw)
    points, raw = points[good], raw[good]
    if not len(raw):
        return Scan(stamp, points, raw), ""
    start, times, convention = _interpret(name, raw, np.issubdtype(values.dtype, np.integer), stamp)
    if (np.diff(times) < 0).any():
        order = np.argsort(times, kind="stable")
        points, times = points[order], times[order]
    return Scan(start, points, times), convention


def _interpret(name: str, raw: np.ndarray, integer: bool, stamp: float) -> tuple[float, np.ndarray, str]:
    """Start of the sweep (s), times after it (s), and what was understood."""
    low, high = float(raw.min()), float(raw.max())
    if low == high == 0:
        return stamp, raw, f"`{name}` is 0 throughout: every sweep is taken as static"
    for scale, unit in _UNITS:
        if low * scale > _FIRST_EPOCH and abs(low * scale - stamp) < _SAME_CLOCK:
            times = _spanned(name, (raw - low) * scale)
            return low * scale, times, f"`{name}`, absolute, {unit}"
    if low > _FIRST_EPOCH and not integer:
        scale, unit = next((s, u) for s, u in reversed(_UNITS) if low * s > _FIRST_EPOCH or s == 1.0)
        return stamp, _spanned(name, (raw - low) * scale), f"`{name}`, absolute by another clock, {unit}"
    largest = max(-low, high)
    # Whole numbers are nanoseconds by every driver's convention; other values are seconds unless that is absurd.
    units = _UNITS[-1:] if integer else _UNITS
    scale, unit = next(((s, u) for s, u in units if largest * s <= _LONGEST_SWEEP), units[-1])
    times = _spanned(name, raw * scale)
    side = "before the stamp (its end)" if -low > high else "after the stamp (its start)"
    shift = min(low * scale, 0.0)
    return stamp + shift, times - shift, f"`{name}`, {unit} {side}"


def _spanned(name: str, times: np.ndarray) -> np.ndarray:
    span = float(times.max() - times.min())
    if span > _LONGEST_SWEEP:
        raise ValueError(f"a sweep whose `{name}` spans {span:.3g} s; at most {_LONGEST_SWEEP:g} s are possible")
    return times
