"""Words for places about the axis of a bore."""

import numpy as np
from jaxtyping import Float

_SIDES = ("floor", "left wall", "crown", "right wall")
_PART = 0.15  # of the weight: a side that holds less goes unnamed


def name_sides(angle: Float[np.ndarray, " k"], weight: Float[np.ndarray, " k"]) -> str:
    """Name the sides of a section in which most of some weights lie.

    Args:
        angle: Directions from the axis, from left towards up, rad.
        weight: Weight of each.

    Returns:
        `floor`, `left wall`, `right wall`, `crown`, two of them, or `all around`.
    """
    quarter = np.floor((angle + 3 * np.pi / 4) / (np.pi / 2)).astype(np.intp) % 4
    share = np.bincount(quarter, weight, 4) / max(float(weight.sum()), 1e-12)
    named = [_SIDES[k] for k in np.argsort(-share, kind="stable") if share[k] >= _PART]
    if len(named) == 4:
        return "all around"
    return " and ".join(sorted(named)) if len(named) < 3 else ", ".join(sorted(named))


def name_span(start: float, end: float) -> str:
    """Return `12 m` or `from 12 to 30 m` for an interval of stations, m."""
    first, last = f"{start:.0f}", f"{end:.0f}"
    return f"at {first} m" if first == last else f"from {first} to {last} m"
