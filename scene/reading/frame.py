"""Unit and axis order of a registered cloud: declared, given by a flag, or detected; then metres, z up."""

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# Metres of each. Source: NIST SP 811, B.6: the international foot, and the US survey foot of 1200/3937 m.
UNITS = {"m": 1.0, "mm": 1e-3, "ft": 0.3048, "us-ft": 1200 / 3937}
UNIT_NAMES = "m, mm, ft or us-ft"
_AXES = re.compile(r"(-?[xyz])(-?[xyz])(-?[xyz])")
# The least extent of a tunnel's box is a height: at most some 100 m in m, at least some 1000 in mm.
_MM_FROM = 500.0
_LYING = 3.0  # a tunnel longer along "up" than this many times both other extents is not z up
_LYING_LENGTH = 30.0  # m
_Y_UP = "x-zy"


@dataclass(frozen=True)
class Frame:
    """How stored coordinates become metres with z up.

    Attributes:
        unit: A key of `UNITS`.
        axes: Which stored axes point along x, y and z.
        facts: Both, and how each was found, for people and the manifest.
    """

    unit: str
    axes: str
    facts: dict[str, str]

    def apply(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Stored coordinates in m, z up."""
        order, signs = _parsed(self.axes)
        return points[:, order] * (signs * UNITS[self.unit])


def choose(sample: np.ndarray, declared: str | None, unit: str | None, axes: str | None) -> Frame:
    """The frame of a cloud; flags come before declarations, declarations before detection.

    Args:
        sample: Points from all over the cloud, as stored; few or none where the unit is declared, `(k, 3)`.
        declared: Unit the file itself gives; words other than a key of `UNITS` are refused.
        unit: Unit by flag.
        axes: Axes by flag.

    Raises:
        ValueError: A flag is no unit, or no order of axes; the file declares another unit.
    """
    if unit is not None and unit not in UNITS:
        raise ValueError(f"unit {unit!r} is none of {UNIT_NAMES}")
    if unit is None and declared not in (None, *UNITS):
        raise ValueError(f"its coordinates are in {declared}, not in {UNIT_NAMES}; --unit overrides what it says")
    if axes is not None:
        _parsed(axes)
    finite = sample[np.isfinite(sample).all(axis=1)]
    extent = np.zeros(3)
    if len(finite):
        low, high = np.percentile(finite, [1, 99], axis=0) if len(finite) > 2 else (finite.min(0), finite.max(0))
        extent = high - low
    detected = "mm" if extent.min() > _MM_FROM else "m"
    found = unit or declared or detected
    how = "by flag" if unit else "declared" if declared else f"detected: least extent {extent.min():.4g}"
    metres = extent * UNITS[found]
    lying = metres[2] > max(_LYING * metres[:2].max(), _LYING_LENGTH)
    order = axes or (_Y_UP if lying else "xyz")
    why = "by flag" if axes else "detected: longest along z, so y is taken as up" if lying else "by default, z up"
    if np.linalg.det(np.eye(3)[_parsed(order)[0]] * _parsed(order)[1][:, None]) < 0:
        why += ", mirrored"
    return Frame(found, order, {"unit": f"{found} ({how})", "axes": f"{order} ({why})"})


def _parsed(axes: str) -> tuple[list[int], np.ndarray]:
    match = _AXES.fullmatch(axes)
    letters = [part[-1] for part in match.groups()] if match else []
    if match is None or len(set(letters)) != 3:
        raise ValueError(f"axes {axes!r} are not x, y and z in some order, each with or without a minus (xyz, -yxz, …)")
    return ["xyz".index(letter) for letter in letters], np.array([-1.0 if p[0] == "-" else 1.0 for p in match.groups()])
