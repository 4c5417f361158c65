"""Errors of a recording, each with one clear sentence; codes of refusals, of warnings and of what is cut away."""

from enum import IntEnum, StrEnum
from pathlib import Path

from subterra_jax.host.errors import SubterraError


class RecordingError(SubterraError):
    """An input cannot be read, or is not what it says it is."""


class Refusal(StrEnum):
    """Why no scene can be built, for programs; a bore that was built is refused by its warning's code."""

    NO_BORE = "no_bore"  # Nothing in it is enclosed, or lies on a wall around an open middle
    OPEN = "open"  # Open above: a street or a cutting
    PLANE = "plane"  # All points on one plane
    UPRIGHT = "upright"  # A vertical shaft
    ROOM = "room"  # Not longer than wide, or much wider than usual on the way
    NARROW = "narrow"  # Too narrow to be followed
    SHORT = "short"  # Shorter than the least length
    UNSEEN = "not_seen"  # Too little of the wall was seen, or profiles are too far apart
    FOLDED = "folded"  # Sections cut each other, or make no solid
    CROP = "crop"  # `--crop` is no box, or holds no point
    RINGS = "rings"  # Rings of a survey that make no bore
    TRACK = "track"  # A track by standard that the bore is too narrow for
    LEVEL = "level"  # No wall at the LiDAR's height
    MUJOCO = "mujoco"  # MuJoCo does not compile the scene
    POSES = "no_poses"  # Poses cannot be found, or leave no return


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
    DENT = "dent"  # A crown dented inwards
    GRADE = "grade"  # Steeper than any road or railway
    LYING = "lying"  # A tunnel on its side
    SHAFT = "shaft"  # A vertical shaft
    SIZE = "size"  # Wider or higher than any tunnel, or smaller
    # What was seen and not built, or built and not seen
    BEYOND = "beyond"  # Most returns lie beyond the ends
    CUT = "cut"  # A branch, a room or a neighbour was cut away
    CUT_SHORT = "cut_short"  # The lining goes on behind an end
    PLACE = "place"  # Unexplained returns in one place
    UNEXPLAINED = "unexplained"  # Too many returns far from the model
    UNSEEN = "unseen"  # A patch of wall without returns
    # Lining and track
    BY_STANDARD = "by_standard"  # Rings and pockets that nobody saw
    RAILS = "rails"  # No rails were seen, but they may be there
    SLEEPERS = "sleepers"  # Sleepers that nobody saw


class Cause(IntEnum):
    """Why a point of the uncleaned cloud was cut away; its `words` are for people."""

    words: str

    def __new__(cls, value: int, words: str) -> "Cause":
        one = int.__new__(cls, value)
        one._value_, one.words = value, words
        return one

    KEPT = 0, "the bore"
    SCATTERED = 1, "scattered returns without neighbours"
    BEHIND = 2, "returns behind the wall"
    INSIDE = 3, "things inside the bore"
    BEYOND = 4, "terrain or a cutting beyond a mouth"
    BRANCH = 5, "a branch or a recess"
    ELSEWHERE = 6, "another tunnel or building apart from the bore"
    STANDING = 7, "things that stand along a plane wall"


OUTSIDE = (Cause.BEYOND, Cause.BRANCH, Cause.ELSEWHERE, Cause.STANDING)  # of the bore: no model of it need explain them


class FitError(SubterraError):
    """The input was read, but no tunnel can be found or measured in it, or the bore explains too little of it.

    Attributes:
        code: Of a `Refusal`, or the `Code` of the warning that refuses the bore.
        page: HTML of the report that shows why; empty where there is none.
    """

    def __init__(self, message: str, code: Refusal | Code, page: str = "") -> None:
        super().__init__(message)
        self.code, self.page = code, page

    def about(self, message: str) -> "FitError":
        return FitError(message, self.code, self.page)


def require_input(path: Path) -> Path:
    """Checks that an input exists and can be read, and returns its path.

    Raises:
        RecordingError: Nothing is there, or it cannot be opened.
    """
    if not path.exists():
        raise RecordingError(f"{path}: no such file or folder")
    if not path.is_file() and not path.is_dir():
        raise RecordingError(f"{path}: neither a file nor a folder; a pipe or device cannot be read twice")
    if path.is_file():
        try:
            path.open("rb").close()
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    return path
