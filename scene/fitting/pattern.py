"""How the pockets of a lining stand: in rows along the bore, either side of every ring joint."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter, uniform_filter

from scene.fitting.unroll import Grid

CLEAR = 0.32  # score of a hole that nobody doubts
_ROW_SHARE = 0.3  # of the fullest row, and of the places in a row
_PITCHES = (0.9, 2.1)  # widths of rings in use, m
_MIN_COHERENCE = 0.4
_NEAR_PLACE = 0.12  # m along the bore
_PLACES = 0.05  # m, step in which places in a ring are counted


@dataclass(frozen=True)
class Holes:
    """Holes of the unrolled wall: cell and how clear each is."""

    row: Int[np.ndarray, " p"]
    column: Int[np.ndarray, " p"]
    score: Float[np.ndarray, " p"]

    def where(self, keep: Bool[np.ndarray, " p"]) -> "Holes":
        """Some of them."""
        return Holes(self.row[keep], self.column[keep], self.score[keep])


def in_rows(holes: Holes, columns: int, reach: float) -> Holes:
    """The holes that stand in the rows which the clearest of them form.

    Args:
        holes: All.
        columns: Of the unrolled wall.
        reach: Half the width of a row, in columns.
    """
    clear = np.bincount(holes.column[holes.score > CLEAR], minlength=columns).astype(float)
    window = max(int(2 * reach) | 1, 3)
    filled = uniform_filter(clear, window, mode="wrap") * window
    fullest = maximum_filter(filled, 2 * window + 1, mode="wrap")
    peaks = np.flatnonzero((filled == fullest) & (filled > max(_ROW_SHARE * filled.max(), 2)))
    return holes.where(_near_columns(holes, peaks, columns, reach))


def in_pattern(faint: Holes, found: Holes, grid: Grid, reach: float) -> Holes:
    """Those found, and the fainter holes that stand where the pattern of those found has a pocket.

    Holes faint in themselves, as pockets are that the scanner looks at head on, make a row where most of its places
    either side of the joints hold one; chance would fill about a quarter of them.

    Args:
        faint: All holes, however faint.
        found: Those that are clear, in rows.
        grid: Of the unrolled wall.
        reach: Half the width of a row, in columns.
    """
    station = (found.row + 0.5) * grid.step
    joints = ring_joints(station, grid.rows * grid.step)
    if len(joints) < 2:
        return found
    pitch = float(np.median(np.diff(joints)))
    in_place = faint.where(_in_places(faint, station, joints[0], pitch, grid.step))
    window = max(int(2 * reach) | 1, 3)
    filled = uniform_filter(np.bincount(in_place.column, minlength=grid.columns).astype(float), window, mode="wrap")
    everything = uniform_filter(np.bincount(faint.column, minlength=grid.columns).astype(float), window, mode="wrap")
    places = 2 * len(joints)
    peaks = np.flatnonzero(
        (filled == maximum_filter(filled, 2 * window + 1, mode="wrap"))
        & (filled * window > 2 * _ROW_SHARE * places)
        & (filled > 0.6 * everything)
    )
    more = in_place.where(_near_columns(in_place, peaks, grid.columns, reach))
    cells = np.concatenate([np.stack([h.row, h.column], axis=1) for h in (found, more)])
    _, first = np.unique(cells, axis=0, return_index=True)
    score = np.concatenate([found.score, more.score])
    return Holes(cells[first, 0], cells[first, 1], score[first])


def _in_places(holes: Holes, station: np.ndarray, joint: float, pitch: float, step: float) -> Bool[np.ndarray, " p"]:
    """Whether each hole stands as far from its joint as those known do, within `_NEAR_PLACE`."""
    bins = max(round(pitch / _PLACES), 4)
    known = np.bincount(((station - joint) % pitch / pitch * bins).astype(int) % bins, minlength=bins).astype(float)
    spread = uniform_filter(known, 3, mode="wrap")
    places = np.flatnonzero((spread == maximum_filter(spread, 5, mode="wrap")) & (spread > _ROW_SHARE * spread.max()))
    at = ((holes.row + 0.5) * step - joint) % pitch
    apart = np.abs(at[:, None] - (places[None] + 0.5) * pitch / bins)
    return np.minimum(apart, pitch - apart).min(axis=1) < _NEAR_PLACE


def _near_columns(holes: Holes, peaks: np.ndarray, columns: int, reach: float) -> Bool[np.ndarray, " p"]:
    if not len(peaks):
        return np.zeros(len(holes.row), bool)
    apart = np.abs((holes.column[:, None] - peaks[None] + columns / 2) % columns - columns / 2).min(axis=1)
    return apart <= max(reach, 1.5)


def ring_joints(station: Float[np.ndarray, " p"], length: float) -> Float[np.ndarray, " r"]:
    """Stations of the ring joints that the pockets straddle, m; empty where no pitch fits."""
    step = _PITCHES[0] ** 2 / (8 * max(length, 1.0))
    pitch = np.arange(*_PITCHES, step)
    wave = np.exp(2j * np.pi * station[None] / pitch[:, None]).mean(axis=1)
    best = int(np.argmax(np.abs(wave)))
    if np.abs(wave[best]) < _MIN_COHERENCE:
        return np.empty(0)
    phase = np.angle(wave[best]) / (2 * np.pi) * pitch[best] % pitch[best]
    return np.arange(phase, length, pitch[best])
