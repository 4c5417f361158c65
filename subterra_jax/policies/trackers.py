"""Who counts rings for a network: a tracker by name."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

from subterra_jax.baselines.reckoning import StepDistances
from subterra_jax.baselines.rings import grid as ringgrid
from subterra_jax.baselines.rings import loop as rings


@dataclasses.dataclass(frozen=True)
class Tracker:
    """Four functions with the arguments of those of `rings`; the track has at least the fields that `senses` shows.

    Attributes:
        start: `(batch, n_beams)` to a track that knows nothing.
        moved: Distance driven, m, of what was commanded and what the odometer read.
        advance: `(track, ranges, moved, direction, pitch)` to the track after a scan.
        anew: `(track, keep)` to the track, at its start where `keep` is 0.
    """

    start: Callable[..., Any]
    moved: Callable[..., Any]
    advance: Callable[..., Any]
    anew: Callable[..., Any]


TRACKERS = {
    # The first released policies have this one.
    "loop": Tracker(rings.start, rings.fuse_distances, rings.advance, rings.restart),
    # It sees past what stands in the tunnel.
    "careful": Tracker(rings.start, rings.fuse_distances, partial(rings.advance, careful=True), rings.restart),
    # On wet rail too.
    "grid": Tracker(ringgrid.start, StepDistances, ringgrid.advance, ringgrid.restart),
}


def tracker(name: str) -> Tracker:
    """The tracker of a name.

    Raises:
        ValueError: There is none.
    """
    if name not in TRACKERS:
        raise ValueError(f"tracker must be one of {', '.join(TRACKERS)}, got {name!r}")
    return TRACKERS[name]
