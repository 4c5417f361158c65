"""Scans of a straight tunnel with rings of pockets, written down."""

import numpy as np

HALF_WIDTH, DEPTH, PITCH, N_BEAMS = 2.8, 0.13, 1.35, 16
ANGLE = 2.0 * np.pi * np.arange(N_BEAMS) / N_BEAMS


def scans(station: np.ndarray, direction: np.ndarray, rng: np.random.Generator, pockets: bool = True) -> np.ndarray:
    """Ranges on the axis of a straight tunnel whose left wall has pairs of pockets and whose right wall single ones."""
    with np.errstate(divide="ignore"):
        smooth = np.minimum(HALF_WIDTH / np.abs(np.sin(ANGLE)), 30.0)
    hit = station[:, None] + direction[:, None] * smooth * np.cos(ANGLE)
    left = direction[:, None] * np.sin(ANGLE) > 0.0
    place = np.mod(hit - 0.4, PITCH)
    inside = (np.abs(place - 0.5) < 0.1) | (left & (np.abs(place - 0.9) < 0.1))
    ranges = smooth * np.where(inside & pockets, 1.0 + DEPTH / HALF_WIDTH, 1.0)
    return np.clip(ranges + rng.normal(scale=0.05, size=ranges.shape), 0.0, 30.0).astype(np.float32)
