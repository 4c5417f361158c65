"""Walls that no scanner saw: a side between what was seen above and below it is closed by a straight line."""

import numpy as np
from jaxtyping import Float

_WIDEST = np.deg2rad(120.0)  # a wider gap has no two ends that a line could join
_LEAST = np.deg2rad(15.0)  # narrower ones are filled from their neighbours as well as by any line
_SIDE = 0.7  # |cos| of the middle of a gap: those of walls; a crown is round, and a floor lower than what was seen


def fill_sides(
    radius: Float[np.ndarray, "rows cols"], angle: Float[np.ndarray, " cols"]
) -> Float[np.ndarray, "rows cols"]:
    """Fills wide gaps of NaN in the walls of sections by the straight line between their ends.

    The nearest thing seen below a wall is the corner of the floor, half as far again from the axis as the wall is: a
    wall filled from it would stand aside by most of a metre.

    Args:
        radius: Distance of the wall from the axis, m; NaN where nothing was seen. Other gaps stay NaN.
        angle: Directions from the axis, evenly all around, rad.
    """
    result, count = radius.copy(), len(angle)
    step = 2 * np.pi / count
    for row in np.flatnonzero(np.isnan(radius).any(axis=1) & np.isfinite(radius).any(axis=1)):
        seen = np.flatnonzero(np.isfinite(radius[row]))
        for before, behind in zip(seen, np.append(seen[1:], seen[0] + count), strict=True):
            width = (behind - before) * step
            inside = np.arange(before + 1, behind)
            if not _LEAST < width < _WIDEST or abs(np.cos(angle[before] + width / 2)) < _SIDE:
                continue
            r0, r1 = radius[row, before], radius[row, behind % count]
            turn = (inside - before) * step
            result[row, inside % count] = r0 * r1 * np.sin(width) / (r0 * np.sin(turn) + r1 * np.sin(width - turn))
    return result
