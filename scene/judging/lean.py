"""A bore that leans to one side all along: a mount that is off in roll, or a cloud that was never levelled.

Sweeps that all err by the same roll fit each other, so nothing blurs. But floor and walls lean together then, where a
cross-fall leans the floor alone.
"""

import numpy as np
from jaxtyping import Float

from scene.bore import Bore
from scene.judging.codes import Code, name_span
from scene.judging.judge import Warned

_BOTTOM = np.deg2rad(28)  # to each side of straight down: floor
_FLAT = 0.02  # m rms about a line: with more it is no flat floor
_LEAST = np.deg2rad(1.2)
_ALIKE = np.deg2rad(0.6)  # about the usual lean
_MOST_OF_IT = 0.8  # share of the stations that lean alike
_SIDES = np.deg2rad(
    np.arange(70.0, 130.0)
)  # from straight up, to both sides: walls; what hangs under a crown is on one side
_EVENER, _UNEVEN = 0.5, 0.01  # share of the difference between both sides that is left; m of it when taken as upright


def doubt_lean(bore: Bore) -> list[Warned]:
    """Warn of a flat floor that leans all along, if both walls are alike about a middle that leans as it does."""
    near = np.abs(np.angle(np.exp(1j * (bore.angle + np.pi / 2)))) < _BOTTOM
    across, upward = (bore.radius * turn(bore.angle) for turn in (np.cos, np.sin))
    floor = np.array([_fit_floor(y, z) for y, z in zip(across[:, near], upward[:, near], strict=True)])
    lean = float(np.nanmedian(floor)) if np.isfinite(floor).any() else 0.0
    alike = np.abs(floor - lean) < _ALIKE
    if abs(lean) < _LEAST or alike.mean() < _MOST_OF_IT:
        return []
    section = np.median(bore.radius[alike], axis=0)
    upright, leaning = (_differ(bore.angle, section, middle) for middle in (0.0, lean))
    if upright < _UNEVEN or leaning > _EVENER * upright:
        return []
    rows = np.flatnonzero(alike)
    start, end = float(bore.station[rows[0]]), float(bore.station[rows[-1]])
    return [Warned(
        Code.LEAN,
        f"{name_span(start, end)} floor and walls lean together by {np.rad2deg(abs(lean)):.1f}°, "
        f"{'left' if lean > 0 else 'right'} side up: is the roll of the LiDAR's mount off, or was the cloud not "
        "levelled? In a bend it may be built so",
        start, end,
    )]  # fmt: skip


def _fit_floor(across: Float[np.ndarray, " k"], upward: Float[np.ndarray, " k"]) -> float:
    """Lean of a flat floor, rad, positive where it rises to the left; NaN where it is not flat."""
    slope, height = np.polyfit(across, upward, 1)
    flat = np.sqrt(np.mean((upward - height - slope * across) ** 2)) < _FLAT
    return float(np.arctan(slope)) if flat else np.nan


def _differ(angle: Float[np.ndarray, " m"], section: Float[np.ndarray, " m"], lean: float) -> float:
    """Mean difference of a section's sides about a middle that leans from upright by some angle to the left, m.

    The axis may stand beside that middle: what a step to the side explains does not count.
    """
    left, right = (
        np.interp(np.pi / 2 + lean + sign * _SIDES, angle, section, period=2 * np.pi) for sign in (1.0, -1.0)
    )
    aside = np.sin(_SIDES)
    return float(np.mean(np.abs(left - right - aside * ((left - right) @ aside) / (aside @ aside))))
