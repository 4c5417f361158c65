"""Clouds with one trouble each, most in 60 m of a 5.5 m arch: what builders have got wrong without a word, or refused.

Each takes a generator of random numbers, and returns points (m, survey frame) and the fields of the truth.
"""

import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from manifold3d import Manifold, OpType

from tests.benchmarks.dirty.clouds.air import Arch, box, draw_alignment, prism, trapezoid
from tests.benchmarks.dirty.clouds.files import write_laz, write_truth
from tests.benchmarks.dirty.clouds.scanner import HEIGHT, Scan, choose
from tests.benchmarks.dirty.clouds.site import LENGTH, Site, bore

Cloud = tuple[np.ndarray, dict[str, Any]]
HALF = 2.75  # m, half-width of the arch
CLEARED = ("stray", "outlier", "scatter", "lone", "not the bore", "removed")
THINGS = ("vehicle", "object", "train", "obstacle", "hides", "hidden", "thing", "furniture", "stands", "parked")
OPENINGS = ("niche", "branch", "passage", "alcove", "opening", "recess", "stub", "lay-by", "side")
UNSEEN = ("unseen", "not seen", "no return", "nobody saw", "never seen", "shadow", "missing", "hidden", "gap", "filled",
          "hardly a return", "guess")  # fmt: skip
UNEXPLAINED = ("unexplained", "not explained", "no part of the bore", "inside the bore", "off the walls", "removed",
               "not the wall that was built", "further than")  # fmt: skip
OUTSIDE = ("portal", "cutting", "mouth", "outside", "terrain", "in the open", "beyond")


def finish(rng: np.random.Generator, site: Site, seen: Scan | None = None, extra: np.ndarray | None = None) -> Cloud:
    """Return the points of a site, or of the part of it that was seen, with extra points, m, and the truth."""
    whole = site.scanned(rng)
    seen = whole if seen is None else seen
    points = seen.point if extra is None else np.concatenate([seen.point, extra])
    return points, site.truth(rng, whole)


def clean(rng: np.random.Generator) -> Cloud:
    """Return the bare arch."""
    return finish(rng, bore(draw_alignment(rng)))


def outliers(rng: np.random.Generator) -> Cloud:
    """Return the arch with 1 % of points anywhere in its box, which is 4 m larger to all sides."""
    site = bore(draw_alignment(rng)).telling(cause=CLEARED)
    points, truth = finish(rng, site)
    low, high = points.min(axis=0) - 4.0, points.max(axis=0) + 4.0
    return np.concatenate([points, rng.uniform(low, high, (len(points) // 100, 3))]), truth


def _beside(site: Site, left: float) -> Site:
    tripods = site.tripods.copy()
    tripods[:, 1] = left
    return replace(site, tripods=tripods)


def vehicle(rng: np.random.Generator) -> Cloud:
    """Return the arch with a parked vehicle of 6 m."""
    at, side = rng.uniform(20.0, 34.0), rng.choice([-1.0, 1.0])
    low, high = sorted([side * 0.1, side * 2.0])
    body = box((at, low, 0.25), (at + 6.0, high, 1.1)) + box((at + 1.2, low, 0.25), (at + 6.0, high, 2.0))
    wheels = [box((at + s, low, 0.0), (at + s + 0.6, high, 0.3)) for s in (0.8, 4.5)]
    site = _beside(bore(draw_alignment(rng)), -side * 0.8).without(body + wheels[0] + wheels[1])
    return finish(rng, site.telling(trouble=(at, at + 6.0), cause=THINGS))


def _hidden(rng: np.random.Generator, site: Site, kept: Callable[[np.ndarray], np.ndarray]) -> Cloud:
    whole = site.scanned(rng)
    return choose(whole, kept(whole.local)).point, site.truth(rng, whole)


def left_wall(rng: np.random.Generator) -> Cloud:
    """Return the arch whose left wall nobody saw up to the springing."""
    site = bore(draw_alignment(rng)).telling(cause=(*UNSEEN, "wall"))
    return _hidden(rng, site, lambda p: (p[:, 1] < HALF - 0.05) | (p[:, 2] > site.arch.springing))


def gap(rng: np.random.Generator) -> Cloud:
    """Return the arch with 12 m that nobody scanned."""
    at = rng.uniform(18.0, 30.0)
    site = bore(draw_alignment(rng)).telling(cause=UNSEEN, trouble=(at, at + 12.0))
    return _hidden(rng, site, lambda p: (p[:, 0] < at) | (p[:, 0] > at + 12.0))


def crown(rng: np.random.Generator) -> Cloud:
    """Return the arch whose crown was not seen: nothing from 60 cm above the springing on."""
    site = bore(draw_alignment(rng)).telling(cause=("crown", "roof", "ceiling", *UNSEEN))
    return _hidden(rng, site, lambda p: p[:, 2] < site.arch.springing + 0.6)


def niche(rng: np.random.Generator) -> Cloud:
    """Return the arch with a niche 3 m wide and 2.5 m deep in a wall."""
    at, side = rng.uniform(20.0, 36.0), rng.choice([-1.0, 1.0])
    low, high = sorted([side * (HALF - 0.3), side * (HALF + 2.5)])
    site = bore(draw_alignment(rng))
    site = replace(site, air=site.air + box((at, low, 0.0), (at + 3.0, high, 2.4)))
    return finish(rng, site.telling(trouble=(at, at + 3.0), cause=OPENINGS))


def duct(rng: np.random.Generator) -> Cloud:
    """Return the arch with a ventilation duct of 80 cm under its crown, all along."""
    turn = np.linspace(0.0, 2.0 * np.pi, 33)[:-1]
    tube = np.stack([0.4 * np.cos(turn), 4.75 + 0.4 * np.sin(turn)], axis=1)
    site = bore(draw_alignment(rng)).without(prism(tube, -0.1, LENGTH + 0.1))
    return finish(rng, site.telling(cause=("duct", "pipe", *UNEXPLAINED), must_say=True))


def pillars(rng: np.random.Generator) -> Cloud:
    """Return a bore of 9 m with a row of pillars of 50 cm along its middle, 6 m apart."""
    arch = Arch(9.0, 6.5, 2.5)
    rows = [box((s, -0.25, -0.1), (s + 0.5, 0.25, 6.6)) for s in np.arange(4.0, LENGTH - 2.0, 6.0)]
    site = _beside(bore(draw_alignment(rng), arch), 2.0)
    both = replace(site, tripods=np.concatenate([site.tripods, site.tripods * (1, -1, 1)]))
    site = both.without(Manifold.batch_boolean(rows, OpType.Add))
    return finish(rng, site.telling(cause=("pillar", "column", *UNEXPLAINED), must_say=True))


def cutting(rng: np.random.Generator) -> Cloud:
    """Return the arch, whose last mouth opens into 10 m of a cutting with slopes."""
    site = bore(draw_alignment(rng))
    top, end = 9.0, LENGTH + 10.0
    outline = trapezoid(HALF + rng.uniform(0.2, 1.0), rng.uniform(0.7, 1.2), top)
    stands = np.arange(LENGTH + 1.5, end, 4.0)
    more = np.stack([stands, 0 * stands, np.full_like(stands, HEIGHT)], axis=1)

    def sky(local: np.ndarray) -> np.ndarray:
        return (local[:, 0] < 1e-3) | (local[:, 0] > end - 1e-3) | (local[:, 2] > top - 1e-3)

    air = site.air + prism(outline, LENGTH, end)
    site = replace(site, air=air, sky=sky, tripods=np.concatenate([site.tripods, more]))
    return finish(rng, site.telling(cause=OUTSIDE))


def road(rng: np.random.Generator) -> Cloud:
    """Return a road bore of 11.5 m with kerbs on both sides."""
    arch = Arch(11.5, 7.5, 2.2)
    kerbs = [
        box((-1.0, *low), (LENGTH + 1.0, *high)) for low, high in (((-6, -1), (-4.6, 0.18)), ((4.6, -1), (6, 0.18)))
    ]
    site = bore(draw_alignment(rng), arch).without(kerbs[0] + kerbs[1])
    return finish(rng, site.telling(track="none", cause=("kerb", "walkway")))


def skewed(rng: np.random.Generator) -> Cloud:
    """Return the arch, cut off by a portal at 40° to its axis."""
    side, lean = rng.choice([-1.0, 1.0]), np.tan(np.radians(40.0))
    site = bore(draw_alignment(rng))
    at = LENGTH - HALF * lean
    normal = np.array([-1.0, side * lean, 0.0])  # inside: station < at + side * lean * left
    air = site.air.trim_by_plane(normal, -at / float(np.linalg.norm(normal)))

    def outside(local: np.ndarray) -> np.ndarray:
        return (local[:, 0] < 1e-3) | (local @ normal < 1e-3 - at)

    site = replace(site, air=air, sky=outside, tripods=site.tripods[site.tripods[:, 0] < at - HALF])
    return finish(rng, site.telling(span=(2.0, at - HALF * lean - 1.0), cause=(*OUTSIDE, "skew")))


def room(rng: np.random.Generator) -> Cloud:
    """Return a room of 12 × 10 × 4 m, which is no tunnel."""
    alignment = draw_alignment(rng)
    tripods = np.array([(4.0, 0.0, HEIGHT), (8.0, 1.0, HEIGHT)])
    site = Site(alignment, Arch(), 20.0, box((0, -5, 0), (12, 5, 4)), tripods, lambda local: np.zeros(len(local), bool))
    axis = alignment.place(np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0]]))
    told = {"expect": "refused", "cause": ("room",), "span": np.array([0.0, 20.0]), "width": np.nan}
    return site.scanned(rng).point, {"axis": axis, "wall": np.empty((0, 3)), **told}


def y_up(rng: np.random.Generator) -> Cloud:
    """Return the arch with y up, as modelling programs have it: x, z, -y."""
    points, truth = clean(rng)
    return points[:, [0, 2, 1]] * (1.0, 1.0, -1.0), {**truth, "cause": ("axes", "y up")}


MAKERS = (clean, outliers, vehicle, left_wall, gap, crown, niche, duct, pillars, cutting, road, skewed, room, y_up)


def make_troubles(folder: Path, seed: int = 0, only: tuple[str, ...] = ()) -> None:
    """Writes the cloud of each maker, or of those of some names, with its truth."""
    for make in MAKERS:
        if not only or make.__name__ in only:
            points, truth = make(np.random.default_rng([seed, zlib.crc32(make.__name__.encode())]))
            write_laz(folder / f"{make.__name__}.laz", points)
            write_truth(folder / f"{make.__name__}_truth.npz", "trouble", truth)
