"""Pipes, trays and ducts that hang free under a ceiling all along: they hide it in some directions, and are no wall.

A wall goes on to both sides. Where a section comes nearer at once and as suddenly goes back, and what is between lies
inside the straight line from one edge to the other, it is a thing in the bore, however long it is.
"""

import numpy as np
from jaxtyping import Float

_OVERHEAD = 0.35  # sine of the lowest direction: what stands on the floor or leans on a wall is told elsewhere
_JUMP = 0.4  # m at both edges
_INSIDE = 0.3  # m within the line between them
_WIDEST = np.deg2rad(60.0)


def bridge_hanging(
    radius: Float[np.ndarray, "rows cols"], angle: Float[np.ndarray, " cols"]
) -> Float[np.ndarray, "rows cols"]:
    """Return sections with the straight line of the ceiling in place of what hangs under it, m.

    Args:
        radius: Distance of the wall from the axis, m; nowhere NaN.
        angle: Directions from the axis, growing, rad.
    """
    over = np.flatnonzero(np.sin(angle) > _OVERHEAD)
    result = radius.copy()
    widest = int(_WIDEST / (angle[1] - angle[0]))
    step = np.diff(radius[:, over], axis=1)
    nearer, farther = step < -_JUMP, step > _JUMP
    for row in np.flatnonzero(nearer.any(axis=1) & farther.any(axis=1)):
        lefts, rights = np.flatnonzero(nearer[row]), np.flatnonzero(farther[row]) + 1
        result[row, over] = _bridge_section(radius[row, over], angle[over], lefts, rights, widest)
    return result


def _bridge_section(
    section: Float[np.ndarray, " k"], angle: Float[np.ndarray, " k"], lefts: np.ndarray, rights: np.ndarray, widest: int
) -> Float[np.ndarray, " k"]:
    """Return the overhead part of a section with a line over each thing that hangs in it.

    Args:
        section: Distances from the axis, m.
        angle: Their directions, rad.
        lefts: Places before a jump towards the axis, growing.
        rights: Places after a jump away from it, growing.
        widest: Most places that a thing covers.
    """
    section, beyond = section.copy(), 0
    for left in lefts:
        if left < beyond:
            continue  # inside the thing before
        for right in rights[(rights > left + 1) & (rights <= left + 1 + widest)]:
            inside = np.arange(left + 1, right)
            line = _line(section[left], section[right], angle[inside] - angle[left], angle[right] - angle[left])
            if (section[inside] < line - _INSIDE).all():
                section[inside], beyond = line, int(right)
                break
    return section


def _line(first: float, last: float, turn: Float[np.ndarray, " k"], whole: float) -> Float[np.ndarray, " k"]:
    """Distances to the straight line between two places, by the turn from the first one, rad."""
    return first * last * np.sin(whole) / (first * np.sin(turn) + last * np.sin(whole - turn))
