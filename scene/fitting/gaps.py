"""Walls that no scanner saw: at an end as they were before it, else a straight line between crown and floor."""

import numpy as np
from jaxtyping import Bool, Float, Int

_WIDEST = np.deg2rad(120.0)  # a wider gap has no two ends that a line could join
_LEAST = np.deg2rad(15.0)  # narrower ones are filled from their neighbours as well as by any line
_SIDE = 0.7  # |cos| of the middle of a gap: those of walls; a crown is round, and a floor lower than what was seen


def fill_sides(
    radius: Float[np.ndarray, "rows cols"], angle: Float[np.ndarray, " cols"], reach: int = 0
) -> Float[np.ndarray, "rows cols"]:
    """Fills wide gaps of NaN in sections: at an end from the row before, and else walls by the line between their ends.

    The nearest thing seen below a wall is the corner of the floor, half as far again from the axis as the wall is: a
    wall filled from it would stand aside by most of a metre. The line between floor and crown cuts a wall off that
    nobody saw down to its foot, by half a metre: where a scan ends aslant, the wall goes on as it was.

    Args:
        radius: Distance of the wall from the axis, m; NaN where nothing was seen. Other gaps stay NaN.
        angle: Directions from the axis, evenly all around, rad.
        reach: Rows that a wall goes on as it was, where its direction is unseen from there to the end of the bore.
    """
    result, count = radius.copy(), len(angle)
    step = 2 * np.pi / count
    last = _last_rows(np.isfinite(radius), reach)
    for row in np.flatnonzero(np.isnan(radius).any(axis=1) & np.isfinite(radius).any(axis=1)):
        seen = np.flatnonzero(np.isfinite(radius[row]))
        for before, behind in zip(seen, np.append(seen[1:], seen[0] + count), strict=True):
            width = (behind - before) * step
            inside = np.arange(before + 1, behind)
            if width <= _LEAST:
                continue
            columns = inside % count
            result[row, columns] = radius[last[row, columns], columns]
            inside = inside[np.isnan(result[row, columns])]
            if width >= _WIDEST or abs(np.cos(angle[before] + width / 2)) < _SIDE:
                continue
            r0, r1 = radius[row, before], radius[row, behind % count]
            turn = (inside - before) * step
            result[row, inside % count] = r0 * r1 * np.sin(width) / (r0 * np.sin(turn) + r1 * np.sin(width - turn))
    return result


def _last_rows(seen: Bool[np.ndarray, "rows cols"], reach: int) -> Int[np.ndarray, "rows cols"]:
    """Return the row that last showed each direction, where none follows and it is within `reach`; else its own."""
    rows, count = np.arange(len(seen))[:, None], len(seen)
    first, last = np.argmax(seen, axis=0), count - 1 - np.argmax(seen[::-1], axis=0)
    last_seen = np.where(rows > last, last, np.where(rows < first, first, rows))
    return np.where(seen.any(axis=0) & (np.abs(last_seen - rows) <= reach), last_seen, rows)
