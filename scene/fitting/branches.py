"""A room on the way: a bore that is much wider than usual over more than a niche, a door or a portal."""

import numpy as np
from jaxtyping import Float

from scene.errors import FitError

_PORTAL = 6.0  # m from an end within which a bore may flare open
_ROOM, _ROOM_LENGTH = 2.0, 5.0  # times the median width; m, longer than a niche


def require_no_room(station: Float[np.ndarray, " n"], width: Float[np.ndarray, " n"]) -> None:
    """Refuses a bore that is twice as wide as usual over more than 5 m; raises `FitError`.

    Stations are uniform, m. What widens within 6 m of an end is a portal.
    """
    usual = float(np.median(width))
    wide = (width > _ROOM * usual) & (station > _PORTAL) & (station < station[-1] - _PORTAL)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], wide.astype(int), [0]])))
    for first, last in zip(edges[::2], edges[1::2] - 1, strict=True):
        if station[last] - station[first] > _ROOM_LENGTH:
            raise FitError(
                f"from station {station[first]:.0f} to {station[last]:.0f} m the bore is "
                f"{width[first : last + 1].max():.0f} m wide where it is {usual:.1f} m elsewhere: a room, not a tunnel"
            )
