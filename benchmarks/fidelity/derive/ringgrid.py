"""The grid of the rings on the unrolled lining: axial pitch, phase along the tunnel, rows around the section."""

import numpy as np
from jaxtyping import Float
from scipy.signal import correlate, find_peaks

from benchmarks.fidelity.derive.radii import ROW
from benchmarks.fidelity.derive.unrolled import Unrolled

LAGS = (0.5, 4.0)  # m; pitch of rings
BAND = 0.30  # of the pitch to either side in which the candidate's is looked for
HARMONICS = 4
PITCHES = 4.0  # in a window of phase
_RELIEF = 0.03  # m; less is roughness
_FAINT = 1e-4  # m; a mean relief below it is no grid
_HIGH = 0.75  # of the highest peak
_STEPS = 2001
_HEIGHT = 0.25  # of the highest row


def relief(unrolled: Unrolled) -> Float[np.ndarray, "n m"]:
    """Depth of recesses, m; 0 on plain wall, on the floor and where nothing is known."""
    depth = np.nan_to_num(unrolled.depth)
    return np.where((depth > _RELIEF) & unrolled.wall, depth, 0.0)


def along(unrolled: Unrolled) -> Float[np.ndarray, " n"]:
    """Mean relief by chainage, where the wall is known, m."""
    known = (np.isfinite(unrolled.depth) & unrolled.wall).sum(axis=1)
    return relief(unrolled).sum(axis=1) / np.maximum(known, 1)


def around(unrolled: Unrolled) -> Float[np.ndarray, " m"]:
    """Mean relief by direction, m."""
    known = (np.isfinite(unrolled.depth) & unrolled.wall).sum(axis=0)
    return relief(unrolled).sum(axis=0) / np.maximum(known, 1)


def coarse_pitch(signal: Float[np.ndarray, " n"]) -> float | None:
    """Lag of the first high peak of the autocorrelation, m; `None` without relief. Multiples of a pitch are as high."""
    if signal.mean() < _FAINT:
        return None
    centred = signal - signal.mean()
    full = correlate(centred, centred, mode="full")[len(centred) - 1 :]
    full /= np.maximum(len(centred) - np.arange(len(centred)), 1)
    low, high = (min(int(lag / ROW), len(full) - 1) for lag in LAGS)
    peaks, _ = find_peaks(full[low:high])
    if not len(peaks):
        return None
    height = full[low + peaks]
    return float((low + peaks[np.argmax(height > _HIGH * height.max())]) * ROW)


def pitch(unrolled: Unrolled, near: float, band: float) -> float | None:
    """Pitch near another whose comb of four harmonics is strongest, m; `None` without relief."""
    signal = along(unrolled)
    if signal.mean() < _FAINT:
        return None
    tried = near * np.linspace(1 - band, 1 + band, _STEPS)
    centred = (signal - signal.mean()) * np.hanning(len(signal))
    power = sum(np.abs(_at(centred, unrolled.station, order / tried)) ** 2 for order in range(1, HARMONICS + 1))
    return float(tried[np.argmax(power)])


def phases(unrolled: Unrolled, length: float) -> Float[np.ndarray, " w"]:
    """Phase of a pitch in overlapping windows, rad; NaN in a window without relief."""
    signal = along(unrolled)
    size = int(PITCHES * length / ROW)
    result = []
    for start in range(0, max(len(signal) - size, 0) + 1, max(size // 2, 1)):
        part, station = signal[start : start + size], unrolled.station[start : start + size]
        value = _at(part - part.mean(), station, np.array([1.0 / length]))[0]
        result.append(np.angle(value) if part.mean() > _FAINT else np.nan)
    return np.array(result)


def rows(unrolled: Unrolled, arc: Float[np.ndarray, " m"]) -> Float[np.ndarray, " r"]:
    """Where along the section rows of recesses lie, m."""
    signal = around(unrolled)
    smooth = np.convolve(np.concatenate([signal[-2:], signal, signal[:2]]), np.ones(5) / 5, mode="valid")
    if smooth.max() < _FAINT:
        return np.zeros(0)
    peaks, _ = find_peaks(smooth, height=_HEIGHT * smooth.max(), distance=4)
    return arc[peaks]


def _at(signal: np.ndarray, station: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    """Fourier integral of a signal at frequencies, 1/m."""
    parts = np.array_split(frequency, max(len(frequency) // 100, 1))
    return np.concatenate([np.exp(-2j * np.pi * part[:, None] * station) @ signal for part in parts])
