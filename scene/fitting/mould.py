"""The mould that the pockets of a lining come from: place, size and depth, measured on all holes together."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from scene.fitting.section import Sections

CLEAR = 0.32  # score of a hole that nobody doubts
MIN_DEPTH = 0.06  # m behind the wall that no wall reaches
MODES = ("nearest", "wrap")
_PROFILE = 0.30  # half window for the common size, m
_SIDE = 0.5
_OVERSHOOT = 0.7  # of the wall's spread: how far the deepest of a few returns lies beyond the surface, measured
_DEEP_SHARE = 0.75  # quantile over pockets of their deepest return


@dataclass(frozen=True)
class Holes:
    """Holes of the unrolled wall: cell and how clear each is."""

    row: Int[np.ndarray, " p"]
    column: Int[np.ndarray, " p"]
    score: Float[np.ndarray, " p"]

    def where(self, keep: Bool[np.ndarray, " p"]) -> "Holes":
        return Holes(self.row[keep], self.column[keep], self.score[keep])


def patches(field: np.ndarray, holes: Holes, rows: int, columns: int) -> Float[np.ndarray, "p r c"]:
    """Return the field around each hole; beyond the ends the last row holds, around it wraps."""
    at_row = np.clip(holes.row[:, None] + np.arange(-rows, rows + 1), 0, field.shape[0] - 1)
    at_column = (holes.column[:, None] + np.arange(-columns, columns + 1)) % field.shape[1]
    return field[at_row[:, :, None], at_column[:, None, :]]


def refine_positions(
    deficit: np.ndarray, sections: Sections, holes: Holes
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Row and column of each hole's centre of gravity, in cells.

    The side that faces the scanner is seen through the mouth and blurs that rim, so that the hole alone would lie
    4 cm off; being the rim, it counts half.
    """
    missing = np.maximum(patches(deficit, holes, 4, 3), 0.0) ** 2
    side = patches((sections.deepest > MIN_DEPTH).astype(float), holes, 4, 3)
    patch = missing + _SIDE * side
    mass = np.maximum(patch.sum(axis=(1, 2)), 1e-9)
    row = holes.row + (patch.sum(axis=2) @ np.arange(-4, 5)) / mass
    column = holes.column + (patch.sum(axis=1) @ np.arange(-3, 4)) / mass
    return row, column


def slopes(sections: Sections, holes: Holes) -> Float[np.ndarray, " p"]:
    """Cosine between the wall's normal and the radius at each hole; cells on an oblique wall are longer."""
    around = 2 * np.pi / sections.grid.columns
    wall = sections.radius
    before, after = (wall[holes.row, (holes.column + step) % wall.shape[1]] for step in (-3, 3))
    lean = (after - before) / (6 * around) / wall[holes.row, holes.column]
    return 1 / np.sqrt(1 + lean**2)


def common_size(deficit: np.ndarray, sections: Sections, holes: Holes, slope: np.ndarray) -> tuple[float, float]:
    """Length and width of the mould, m, from the mean hole, along and around.

    A voxel that the rim crosses still holds a wall point, so the hole in the thinned cloud is one voxel short each way.
    """
    grid = sections.grid
    across = sections.radius[holes.row, holes.column] * 2 * np.pi / grid.columns / slope  # m a column
    rows, columns = int(_PROFILE / grid.step), int(_PROFILE / np.median(across))
    mean = patches(deficit, holes, rows, columns).mean(axis=0)
    mean = mean - np.median(mean)
    core = mean[rows - 3 : rows + 4, columns - 3 : columns + 4]
    along, around = core.sum(axis=1), core.sum(axis=0)
    length = _spread(along) * grid.step
    width = _spread(around) * float(np.median(across))
    return float(np.clip(length + sections.voxel, 0.05, 0.5)), float(np.clip(width + sections.voxel, 0.05, 0.5))


def _spread(profile: Float[np.ndarray, " k"]) -> float:
    """Width, in cells, of the box with the profile's second moment, less that of one cell."""
    weight = np.maximum(profile, 0.0)
    at = np.arange(len(profile)) - len(profile) // 2
    mass = weight.sum()
    if mass <= 0:
        return 1.0
    centre = (weight @ at) / mass
    variance = (weight @ (at - centre) ** 2) / mass
    return float(np.sqrt(max(12 * variance - 1.0, 1.0)))


def common_depth(sections: Sections, holes: Holes, slope: np.ndarray) -> float:
    """Depth of the mould, m, from the pockets whose backs are seen, less the noise of the deepest return."""
    deepest = patches(sections.deepest, holes, 4, 2).max(axis=(1, 2)) * slope
    return float(np.quantile(deepest, _DEEP_SHARE) - _OVERSHOOT * np.median(sections.spread))
