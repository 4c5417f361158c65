"""Clouds with no tunnel in them, or with two: what a builder must refuse with the true reason, or build with a word."""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from manifold3d import Manifold

from tests.benchmarks.dirty.clouds.air import Alignment, Arch, box, draw_alignment, prism
from tests.benchmarks.dirty.clouds.scanner import HEIGHT
from tests.benchmarks.dirty.clouds.site import Mask, Site, bore
from tests.benchmarks.dirty.clouds.troubles import Cloud, finish

_SECOND = tuple(f"{one} {what}" for one in ("two", "second", "another", "other") for what in ("tunnel", "bore"))


def _no_bore(rng: np.random.Generator, air: Manifold, tripods: list, sky: Mask, cause: tuple[str, ...]) -> Cloud:
    """Return a cloud without a bore, and the truth that it is none."""
    alignment = Alignment(rng.uniform(-np.pi, np.pi), offset=tuple(rng.uniform(500.0, 900.0, 3)))
    site = Site(alignment, Arch(), 20.0, air, np.array(tripods, float), sky)
    nothing: dict[str, Any] = {"expect": "refused", "cause": cause, "span": np.array([0.0, 20.0]), "width": np.nan}
    axis = alignment.place(np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0]]))
    return site.scanned(rng).point, {"axis": axis, "wall": np.empty((0, 3)), **nothing}


def _inside(local: Float[np.ndarray, "p 3"]) -> np.ndarray:
    return np.zeros(len(local), bool)


def room(rng: np.random.Generator) -> Cloud:
    """Return a room of 12 × 10 × 4 m."""
    return _no_bore(rng, box((0, -5, 0), (12, 5, 4)), [(4, 0, 1.7), (8, 1, 1.7)], _inside, ("room",))


def street(rng: np.random.Generator) -> Cloud:
    """Return a street of 80 m between façades 14 m apart and 12 m high."""
    stands = [(s, 1.0, HEIGHT) for s in range(5, 80, 10)]

    def sky(local: np.ndarray) -> np.ndarray:
        return (local[:, 2] > 11.99) | (local[:, 0] < 0.01) | (local[:, 0] > 79.99)

    words = ("street", "no roof", "roof", "crown", "ceiling", "sky", "open above", "overhead")
    return _no_bore(rng, box((0, -7, 0), (80, 7, 12)), stands, sky, words)


def plane(rng: np.random.Generator) -> Cloud:
    """Return bare ground of 60 × 40 m."""

    def sky(local: np.ndarray) -> np.ndarray:
        return local[:, 2] > 1e-3

    stands = [(s, left, HEIGHT) for s in (10, 30, 50) for left in (-10.0, 10.0)]
    return _no_bore(rng, box((0, -20, 0), (60, 20, 9)), stands, sky, ("plane", "surface", "flat", "ground", "no walls"))


def shaft(rng: np.random.Generator) -> Cloud:
    """Return a vertical shaft of 6 m, 30 m deep."""
    tube = Manifold.cylinder(30.0, 3.0, circular_segments=96)
    return _no_bore(rng, tube, [(0, 0, z) for z in range(3, 30, 5)], _inside, ("shaft", "vertical", "steep", "grade"))


def two_tunnels(rng: np.random.Generator) -> Cloud:
    """Return an arch of 60 m and one of 40 m beside it, 16 m from axis to axis."""
    alignment = draw_alignment(rng)
    first = bore(alignment).telling(cause=_SECOND, must_say=True)
    second = prism(first.arch.outline() + np.array([16.0, 0.0]), 8.0, 48.0)
    stands = first.tripods[(first.tripods[:, 0] > 9) & (first.tripods[:, 0] < 47)] + np.array([0.0, 16.0, 0.0])

    def sky(local: np.ndarray) -> np.ndarray:
        aside = local[:, 1] > 8.0
        start, end = np.where(aside, 8.0, 0.0), np.where(aside, 48.0, 60.0)
        return (local[:, 0] < start + 1e-3) | (local[:, 0] > end - 1e-3)

    both = replace(first, air=first.air + second, tripods=np.concatenate([first.tripods, stands]), sky=sky)
    return finish(rng, both)
