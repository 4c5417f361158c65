"""Codes of all warnings of a build, for programs, and words for places about the axis, for people."""

from enum import StrEnum

import numpy as np
from jaxtyping import Float


class Code(StrEnum):
    """Subject of a warning."""

    # How the input was read and posed
    AXES = "axes"  # Y was taken as up
    CALIBRATION = "calibration"  # Control without the place of its prism
    CLOCK = "clock"  # Two clocks of the recording differ
    DOUBLED = "doubled"  # Walls that the cloud shows twice
    LENGTH = "length"  # Nothing measured the length
    POSES = "poses"  # Poses that blur the walls
    ROUNDED = "rounded"  # Coordinates rounded to centimetres
    # Shapes that no tunnel has
    DENT = "dent"  # A section dented inwards
    GRADE = "grade"  # Steeper than any road or railway
    LEAN = "lean"  # Floor and walls lean together
    LYING = "lying"  # A tunnel on its side
    SHAFT = "shaft"  # A vertical shaft
    SIZE = "size"  # Wider or higher than any tunnel, or smaller
    # What was seen and not built, or built and not seen
    BEYOND = "beyond"  # Most returns lie beyond the ends
    CUT = "cut"  # A branch, a room or a neighbour was cut away
    CUT_SHORT = "cut_short"  # The lining goes on behind an end
    PLACE = "place"  # Unexplained returns in one place
    UNEXPLAINED = "unexplained"  # Too many returns far from the model
    UNSEEN = "unseen"  # A piece of wall without returns
    # Lining and track
    BY_STANDARD = "by_standard"  # Rings and pockets that nobody saw
    RAILS = "rails"  # No rails were seen, but they may be there
    SLEEPERS = "sleepers"  # Sleepers that nobody saw


_SIDES = ("floor", "left wall", "crown", "right wall")
_PART = 0.15  # of the weight: a side that holds less goes unnamed


def name_sides(angle: Float[np.ndarray, " k"], weight: Float[np.ndarray, " k"]) -> str:
    """Name the sides of a section in which most of some weights lie, by their directions from left towards up, rad.

    Returns `floor`, `left wall`, `right wall`, `crown`, two of them, or `all around`.
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
