"""Codes of all warnings of a build, for programs; the sentences beside them are for people."""

from enum import StrEnum


class Code(StrEnum):
    """What a warning is about."""

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
