"""Generated tunnels by name: the open world, and `control`.

kinds ─► section, surfaces, fixtures ─► bore ─┬► cut (planar walls) ─┬► open_world (a `TunnelPlan` by name)
geometry (centreline) ────────────────────────┴► solid (the shell) ──┘
"""

from __future__ import annotations

import re

from subterra_jax.host.errors import TunnelError
from subterra_jax.host.loading import load_module
from subterra_jax.procedural import open_world
from subterra_jax.procedural.control import LININGS, NAME, control
from subterra_jax.tunnel.plan import TunnelPlan

__all__ = ["GENERATED", "control", "default_lining", "expand", "generate", "open_world"]

GENERATED = re.compile(rf"{NAME}|(?:(.+):)?(open:.*)")  # before `open:`, a user's module that adds a kind
_SEVERAL = re.compile(r"((?:.+:)?open:[a-z:-]+):(\d+)-(\d+)")


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
        name: `control`, `open:SPLIT:INDEX` or `open:KIND:SPLIT:INDEX`; `FILE.py:open:KIND:SPLIT:INDEX` first runs a
            user's file, which registers the kind.
        linings: Variants to make; `None` for all.
        solid: Make the bore in three dimensions too; `control` has none.

    Raises:
        TunnelError: There is no such tunnel, or it lacks a lining.
        UserCodeError: The user's file cannot be run.
    """
    match = GENERATED.fullmatch(name)
    if match is None:
        raise TunnelError(
            f"no tunnel {name!r}; a generated one is called {NAME}, open:SPLIT:INDEX or open:KIND:SPLIT:INDEX"
        )
    there = LININGS if name == NAME else open_world.VARIANTS
    if missing := [lining for lining in linings or () if lining not in there]:
        raise TunnelError(f"tunnel {name!r} has no lining {missing[0]!r}; it has {', '.join(there)}")
    if name == NAME:
        return control()
    if match[1]:
        load_module(match[1])
    return open_world.plan(match[2], variants=linings or there, solid=solid)
