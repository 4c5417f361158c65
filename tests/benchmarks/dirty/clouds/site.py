"""A tunnel with a scanner in it: what is air, where the tripods stand, and what of it all is lining."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from manifold3d import Manifold

from tests.benchmarks.dirty.clouds.air import Alignment, Arch, prism, surface_of
from tests.benchmarks.dirty.clouds.scanner import HEIGHT, Scan, choose, scan

LENGTH = 60.0  # m, where nothing else is said
_ON_IT = 0.005  # m: a return so near the arch is lining
_LOWEST = 0.5  # m above the floor from which lining is judged
_MARGIN = 2.0  # m inside the mouths that is not judged
_MOST = 6000  # points of the wall in a truth
_TRIPOD_STEP = 6.0  # m

Mask = Callable[[Float[np.ndarray, "p 3"]], Bool[np.ndarray, " p"]]


@dataclass(frozen=True)
class Site:
    """One bore and its surroundings, in straight coordinates."""

    alignment: Alignment  # Course of the bore
    arch: Arch  # Section
    length: float  # Length between the mouths, m
    air: Manifold  # All that is not rock or things
    tripods: Float[np.ndarray, "t 3"]  # Station, left, up of the scanner, m
    sky: Mask  # True for places that bound the model and not the air
    facts: dict[str, Any] = field(default_factory=dict)  # Further fields of the truth

    def telling(self, **facts: Any) -> "Site":
        """Return the site with further fields of the truth."""
        return replace(self, facts={**self.facts, **facts})

    def without(self, thing: Manifold) -> "Site":
        """Return the site with a thing standing in its air."""
        return replace(self, air=self.air - thing)

    def scanned(self, rng: np.random.Generator, spacing: float = 0.06) -> Scan:
        """Return the cloud of the site, thinned to one point in `spacing` m."""
        whole = scan(rng, surface_of(self.air, self.alignment), self.alignment, self.tripods, spacing)
        return choose(whole, ~self.sky(whole.local))

    def truth(self, rng: np.random.Generator, seen: Scan) -> dict[str, Any]:
        """Return the fields of the truth file; see `benchmarks.dirty.truth.Truth`."""
        station = np.arange(0.0, self.length + 1e-9, 0.25)
        middle = np.stack([station, 0 * station, np.full_like(station, 0.5 * self.arch.height)], axis=1)
        span = self.facts.get("span", (_MARGIN, self.length - _MARGIN))
        at, left, up = seen.local.T
        lining = (np.abs(self.arch.depth(left, up)) < _ON_IT) & (up > _LOWEST) & (at > span[0]) & (at < span[1])
        wall = np.flatnonzero(lining)
        wall = np.sort(rng.choice(wall, min(_MOST, len(wall)), replace=False))
        sizes = {"axis_above_floor": 0.5 * self.arch.height, "width": self.arch.width, "height": self.arch.height}
        told = {"span": np.array(span), "ends": np.array([0.0, self.length]), "plain": True, **sizes, **self.facts}
        return {"axis": self.alignment.place(middle), "wall": seen.exact[wall], **told}


def bore(alignment: Alignment, arch: Arch | None = None, length: float = LENGTH) -> Site:
    """Return a bare bore whose mouths open into nothing."""
    arch = arch or Arch()
    station = np.arange(1.5, length - 1.0, _TRIPOD_STEP)
    tripods = np.stack([station, 0.3 + 0 * station, np.full_like(station, HEIGHT)], axis=1)

    def outside(local: np.ndarray) -> np.ndarray:
        return (local[:, 0] < 1e-3) | (local[:, 0] > length - 1e-3)

    return Site(alignment, arch, length, prism(arch.outline(), 0.0, length), tripods, outside)
