"""One section as a star-shaped polygon in polar form: its widths, its heights, its middle."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

N_ANGLES = 360
_HEIGHT_STEP = 0.05
_CHORD_WINDOW = 0.4
# Chords this close to the longest share in the middle, so that noise on one of them does not move it.
_LONG_CHORD = 0.97


@dataclass(frozen=True)
class Extents:
    """Sizes of a section, about the point it is drawn from."""

    width: float  # Largest inner width, m
    height: float  # Floor to crown on the axis, m
    middle: tuple[float, float]  # Lateral and upward offset of mid-width and mid-height, m


def section_angles(count: int = N_ANGLES) -> Float[np.ndarray, " m"]:
    """Return directions of a section's radii, from lateral (left) towards up, rad, the first at -π."""
    return -np.pi + 2 * np.pi * np.arange(count) / count


def measure_section(angle: Float[np.ndarray, " m"], radius: Float[np.ndarray, " m"]) -> Extents:
    """Measures the polygon `radius(angle)`."""
    lateral, upward = radius * np.cos(angle), radius * np.sin(angle)
    height_grid = np.arange(upward.min(), upward.max(), _HEIGHT_STEP)
    left, right = (_wall_at(side, lateral, upward, height_grid) for side in (1, -1))
    chord = left - right
    # A maximum of noisy values is too large, so chords are averaged over 0.4 m of height; a circle loses 4 mm.
    window = min(round(_CHORD_WINDOW / _HEIGHT_STEP), len(chord))
    width = float(np.convolve(chord, np.full(window, 1 / window), mode="valid").max())
    long = chord >= _LONG_CHORD * width
    across = float(np.mean((left + right)[long]) / 2)
    floor, crown = (_wall_at(side, upward, lateral, np.array([across]))[0] for side in (-1, 1))
    return Extents(width, float(crown - floor), (across, float(crown + floor) / 2))


def _wall_at(side: int, across: np.ndarray, along: np.ndarray, at: np.ndarray) -> np.ndarray:
    """`across` of the polygon's half on one side, as a function of `along`."""
    half = np.sign(across) == side
    order = np.argsort(along[half], kind="stable")
    return np.interp(at, along[half][order], across[half][order])
