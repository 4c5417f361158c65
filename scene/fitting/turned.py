"""Rings that turn: their pockets scatter around the bore, but stand at the same few places along every ring.

So rows say nothing of such a lining. Pitch and places are those that the stations of all holes agree on best, whatever
their angles; of pitches that share harmonics it is the one with the fewest places. A hole is a pocket where it stands
at such a place.

Source: the sum of the squared mean waves over the first harmonics, so that two or three places in a ring, which cancel
each other in the first, are seen by the others (Buccheri et al. 1983, Astronomy and Astrophysics 128).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter1d, uniform_filter1d

N_HARMONICS = 4
_BIN = 0.02  # m of station, in which holes are counted
_FINER = 16  # times that the frequencies tried are finer than the length tells apart
_STEPS = np.linspace(-1.0, 1.0, 81)  # of such a frequency, tried at the end
_FOLD = 0.02  # m along a ring, in which places are looked for
_BLUR = 5  # of these
_PLACE = 0.1  # of the fullest place
_RATIOS = (1.0, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2.0)  # of pitches that share harmonics
_NARROW = 0.05  # m along a ring
CROWD = 0.2  # m
NEAR_PLACE = 0.10  # m along the bore


@dataclass(frozen=True)
class Ring:
    """Pitch and places that all rings have in common."""

    pitch: float  # Length of a ring, m
    place: Float[np.ndarray, " k"]  # Places of pockets, m after the stations that are multiples of the pitch

    def holds(self, station: Float[np.ndarray, " p"]) -> Bool[np.ndarray, " p"]:
        """Return which stations, m, lie at a place."""
        apart = np.mod(station[:, None] - self.place + 0.5 * self.pitch, self.pitch) - 0.5 * self.pitch
        return np.asarray(np.abs(apart).min(axis=1, initial=np.inf) < NEAR_PLACE)

    def number(self, station: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Return the number of each station's ring, counted from ring joint or from place."""
        return np.floor((station - self.place[0]) / self.pitch + 0.5)


def find_ring(station: Float[np.ndarray, " p"], length: float, pitches: tuple[float, float]) -> Ring:
    """Finds the pitch, and the places in a ring, that holes agree on best; whether they do is for others to say.

    Takes the stations of at least one hole, the length of the bore, and the least and largest pitch, m.
    """
    pitch = _find_pitch(station, length, pitches)
    bins = max(round(pitch / _FOLD), 8)
    count = np.bincount((np.mod(station, pitch) / pitch * bins).astype(int) % bins, minlength=bins).astype(float)
    full = uniform_filter1d(count, _BLUR, mode="wrap")
    most = maximum_filter1d(full, 2 * round(NEAR_PLACE / _FOLD) + 1, mode="wrap")
    peak = np.flatnonzero((full == most) & (full > _PLACE * full.max()))
    return Ring(pitch, _centre(station, (peak + 0.5) * pitch / bins, pitch))


def _find_pitch(station: Float[np.ndarray, " p"], length: float, pitches: tuple[float, float]) -> float:
    size = 1 << int(np.ceil(np.log2(_FINER * max(length, 4 * pitches[1]) / _BIN)))
    count = np.bincount(np.clip((station / _BIN).astype(int), 0, size - 1), minlength=size)
    power = np.abs(np.fft.rfft(count)) ** 2
    step = 1.0 / (size * _BIN)  # 1/m
    tried = np.arange(int(np.ceil(1.0 / (pitches[1] * step))), int(1.0 / (pitches[0] * step)) + 1)
    best = tried[int(np.argmax(sum(power[k * tried] for k in range(1, N_HARMONICS + 1))))]
    near = (best + _STEPS) * step
    pitch = float(1.0 / near[int(np.argmax(agreement(station, near)))])
    like = [pitch * ratio for ratio in _RATIOS if pitches[0] <= pitch * ratio <= pitches[1]]
    return max(like, key=lambda one: _information(station, one))


def _information(station: Float[np.ndarray, " p"], pitch: float) -> float:
    """Return by how much the places of a pitch, m, make these stations likelier than none, less what chance would.

    Source: Miller 1955, on the bias of the information of a sample.
    """
    bins = round(pitch / _NARROW)
    count = np.bincount((np.mod(station, pitch) / pitch * bins).astype(int) % bins, minlength=bins)
    full = count[count > 0]
    return float(full @ np.log(full * bins / len(station))) - 0.5 * (bins - 1)


def one_a_bin(station: Float[np.ndarray, " p"]) -> Float[np.ndarray, " b"]:
    """Return one station for all those within 20 cm, m: holes beside each other may have one cause."""
    station = np.sort(station)
    _, first, count = np.unique((station / CROWD).astype(int), return_index=True, return_counts=True)
    return station[first + count // 2]


def agreement(station: Float[np.ndarray, " p"], frequency: Float[np.ndarray, " f"]) -> Float[np.ndarray, " f"]:
    """Return Buccheri's statistic of stations, m, at frequencies, 1/m; by chance χ² with two degrees a harmonic."""
    wave = np.exp(2j * np.pi * station[None] * frequency[:, None])
    total = np.zeros(len(frequency))
    for k in range(1, N_HARMONICS + 1):
        total += np.abs((wave**k).sum(axis=1)) ** 2
    return 2.0 * total / max(len(station), 1)


def _centre(station: Float[np.ndarray, " p"], place: Float[np.ndarray, " k"], pitch: float) -> Float[np.ndarray, " k"]:
    """Return each place moved to the mean of the holes near it, m; those that meet there are one."""
    apart = np.mod(station[:, None] - place + 0.5 * pitch, pitch) - 0.5 * pitch
    near = np.abs(apart) < NEAR_PLACE
    moved = np.sort(np.mod(place + (apart * near).sum(axis=0) / np.maximum(near.sum(axis=0), 1), pitch))
    return moved[np.diff(moved, prepend=moved[-1] - pitch) > NEAR_PLACE] if len(moved) > 1 else moved
