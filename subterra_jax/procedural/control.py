"""The negative control: a bore in which no position along the axis looks different from any other."""

import numpy as np

from subterra_jax.procedural.alignment import Alignment
from subterra_jax.procedural.walls import wall
from subterra_jax.tunnel.plan import Lining, TunnelPlan

_LENGTH, _RADIUS, _HALF_WIDTH = 351.0, 300.0, 2.825
_GRID_STEP, _WALL_STEP, _LIDAR_HEIGHT = 0.25, 0.25, 0.7


def control() -> TunnelPlan:
    """A smooth bore of constant width and one constant curvature: 351 m long, 5.65 m wide, a bend of 300 m to the left.

    Out of sight of the mouths (30 m) no LiDAR tells where in it a robot is, so nobody may beat dead reckoning here who
    does so by localisation. It has the lining `smooth` alone, and no rings.
    """
    bend = np.full(2, 1.0 / _RADIUS)
    alignment = Alignment(np.array([0.0, _LENGTH]), bend, _LENGTH, _GRID_STEP)
    station = alignment.station
    at = np.linspace(0.0, _LENGTH, round(_LENGTH / _WALL_STEP) + 1)
    left, right = (wall(alignment, side, at, np.full(len(at), _HALF_WIDTH)) for side in (1.0, -1.0))
    return TunnelPlan(
        name="control",
        provenance="simulated",
        station=station,
        centre=alignment.position(station),
        tangent=alignment.tangent(station),
        elevation=np.zeros(len(station)),
        half_width=np.full(len(station), _HALF_WIDTH),
        lidar_height=_LIDAR_HEIGHT,
        linings={"smooth": Lining(left, right, np.zeros((0, 4)))},
    )
