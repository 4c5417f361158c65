"""Generated tunnels by name: the open world, and `control`.

kinds ─► section, surfaces, fixtures ─► bore ─┬► cut (planar walls) ─┬► open_world (a `TunnelPlan` by name)
geometry (centreline) ────────────────────────┴► solid (the shell) ──┘
"""

from __future__ import annotations

import re

import numpy as np

from subterra_jax.host.errors import TunnelError
from subterra_jax.host.texture import texture_seed
from subterra_jax.procedural import open_world
from subterra_jax.procedural.geometry import Alignment
from subterra_jax.tunnel.plan import Lining, TunnelPlan, Wall

__all__ = ["GENERATED", "control", "default_lining", "expand", "generate", "open_world"]

NAME = "control"
LININGS = ("smooth",)
_LENGTH, _RADIUS, _HALF_WIDTH, _LIDAR_HEIGHT, _STEP = 351.0, 300.0, 2.825, 0.7, 0.25  # m
GENERATED = re.compile(rf"{NAME}|open:.*")
_SEVERAL = re.compile(r"(open:[a-z:-]+):(\d+)-(\d+)")


def expand(name: str) -> list[str]:
    """Expand a name: `open:train:0-255` becomes the names of 256 tunnels, any other name stays one.

    Raises:
        TunnelError: The last comes before the first.
    """
    match = _SEVERAL.fullmatch(name)
    if match is None:
        return [name]
    first, last = int(match[2]), int(match[3])
    if last < first:
        raise TunnelError(f"no tunnels {name!r}: {last} comes before {first}")
    return [f"{match[1]}:{index}" for index in range(first, last + 1)]


def default_lining(name: str) -> str:
    """Return the variant of the walls that a generated tunnel has by default."""
    return LININGS[0] if name == NAME else open_world.VARIANTS[0]


def generate(name: str, linings: tuple[str, ...] | None = None, solid: bool = False) -> TunnelPlan:
    """Generate a tunnel by its name.

    Args:
        name: `control`, `open:SPLIT:INDEX` or `open:KIND:SPLIT:INDEX`.
        linings: Variants to make; `None` for all.
        solid: Make the bore in three dimensions too; `control` has none.

    Raises:
        TunnelError: There is no such tunnel, or it lacks a lining.
    """
    if GENERATED.fullmatch(name) is None:
        raise TunnelError(
            f"no tunnel {name!r}; a generated one is called {NAME}, open:SPLIT:INDEX or open:KIND:SPLIT:INDEX"
        )
    there = LININGS if name == NAME else open_world.VARIANTS
    if missing := [lining for lining in linings or () if lining not in there]:
        raise TunnelError(f"tunnel {name!r} has no lining {missing[0]!r}; it has {', '.join(there)}")
    if name == NAME:
        return control()
    return open_world.plan(name, variants=linings or there, solid=solid)


def control() -> TunnelPlan:
    """Return the negative control, in which no position along the axis looks different from any other.

    It is 351 m long and 5.65 m wide, has one bend of 300 m to the left, the lining `smooth` and no rings. Out of sight
    of the mouths (30 m) no LiDAR tells the station, so localisation cannot beat dead reckoning here.
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
        texture=texture_seed(NAME),
    )
