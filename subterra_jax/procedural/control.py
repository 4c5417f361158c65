"""The negative control: a bore in which no position along the axis looks different from any other."""

import numpy as np

from subterra_jax.procedural.geometry import Alignment
from subterra_jax.tunnel.plan import Lining, TunnelPlan, Wall

NAME = "control"
LININGS = ("smooth",)
_LENGTH, _RADIUS, _HALF_WIDTH, _LIDAR_HEIGHT, _STEP = 351.0, 300.0, 2.825, 0.7, 0.25  # m


def control() -> TunnelPlan:
    """Return the control: 351 m long, 5.65 m wide, one bend of 300 m to the left, the lining `smooth`, no rings.

    Out of sight of the mouths (30 m) no LiDAR tells the station, so localisation cannot beat dead reckoning here.
    """
    alignment = Alignment(np.array([0.0, _LENGTH]), np.full(2, 1.0 / _RADIUS), _LENGTH, _STEP)
    station = alignment.station
    at = np.linspace(0.0, _LENGTH, round(_LENGTH / _STEP) + 1)
    left, right = (Wall(alignment.offset(at, np.full(len(at), y)), at) for y in (_HALF_WIDTH, -_HALF_WIDTH))
    return TunnelPlan(
        name=NAME,
        provenance="simulated",
        station=station,
        centre=alignment.position(station),
        tangent=alignment.tangent(station),
        elevation=np.zeros(len(station)),
        half_width=np.full(len(station), _HALF_WIDTH),
        lidar_height=_LIDAR_HEIGHT,
        linings={"smooth": Lining(left, right, np.zeros((0, 4)))},
    )
