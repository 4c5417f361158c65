"""The gauge from single returns: in a thinned cloud the mean of a voxel mixes the side of a head with its top."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from scene.bore import Bore
from scene.fitting.rails import measure_again
from scene.fitting.trackseen import SeenLine, SeenTrack, above_floor

_TALLEST = 0.8  # m above the floor
_BESIDE = 0.10  # m to each side of the middle of a rail
_CHUNK = 500_000  # points; bounds the memory


def measure_gauge(seen: SeenTrack, low: Float[np.ndarray, "n 3"], bore: Bore) -> SeenTrack:
    """Measures the gauge of each track anew by single returns; what they do not show sharply stays.

    Args:
        seen: Tracks that the thinned cloud shows.
        low: Single returns below the LiDAR, in the tunnel frame, m; none of a cloud that came registered.
        bore: The bore.
    """
    if not seen.shows_rails or not len(low):
        return seen
    parts = [_beside_rails(low[k : k + _CHUNK], bore, seen.lines) for k in range(0, len(low), _CHUNK)]
    near = np.concatenate(parts)
    lines = (SeenLine(one.sleepers, measure_again(one.rails, *near.T), one.bed) if one.rails else one
             for one in seen.lines)  # fmt: skip
    return replace(seen, lines=tuple(lines))


def _beside_rails(
    points: Float[np.ndarray, "n 3"], bore: Bore, lines: tuple[SeenLine, ...]
) -> Float[np.ndarray, "k 4"]:
    """Return station, offset, height above the floor and above the axis of the points near any rail, m."""
    station, lateral, upward, height = above_floor(points, bore)
    near = np.zeros(len(station), bool)
    for rails in (line.rails for line in lines if line.rails is not None):
        near |= np.abs(np.abs(lateral - rails.offset_at(station)) - rails.apart / 2) < _BESIDE
    near &= np.abs(height) < _TALLEST
    return np.column_stack([station, lateral, height, upward])[near]
