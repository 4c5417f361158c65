"""Clouds with troubles of another kind: sharp bends, sections that change, few stations, doubled and rounded points.

As in `troubles`, each maker takes a generator of random numbers, and returns points (m, survey frame) and the fields of
the truth.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tests.benchmarks.dirty.clouds.air import Alignment, Arch, box, draw_alignment, prism
from tests.benchmarks.dirty.clouds.scanner import HEIGHT, choose
from tests.benchmarks.dirty.clouds.site import LENGTH, bore
from tests.benchmarks.dirty.clouds.troubles import CLEARED, OPENINGS, UNSEEN, Cloud, finish

_DOUBLED = ("thick", "blur", "two layers", "doubled", "twice", "registration", "misaligned", "passes")
_ROUNDED = ("round", "resolution", "float", "digit", "grid", "quantis")


@dataclass(frozen=True)
class Course(Alignment):
    """Arcs one after the other, tangent to each other, with a grade; straight before the first and after the last."""

    arcs: tuple[tuple[float, float], ...] = ()  # Length and radius of each, m; a positive radius turns left

    def place(self, local: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"]:
        """Return places given by station, left and up in the survey frame, m."""
        result = np.empty_like(local, dtype=float)
        start, here = 0.0, Alignment(self.yaw, np.inf, 0.0, self.offset)
        ends = np.cumsum([length for length, _ in self.arcs])
        piece = np.searchsorted(ends, local[:, 0])
        for k, (length, radius) in enumerate((*self.arcs, (0.0, np.inf))):
            here = replace(here, radius=radius)
            rows = piece == k
            shifted = local - (start, 0.0, 0.0)
            result[rows] = here.place(shifted[rows])
            end = here.place(np.array([[length, 0.0, 0.0]]))[0]
            start, here = start + length, replace(here, yaw=here.yaw + length / radius, offset=tuple(end))
        result[:, 2] += self.grade * local[:, 0]
        return result


def _course(rng: np.random.Generator, arcs: tuple[tuple[float, float], ...], grade: float = 0.0) -> Course:
    """Draws heading, place and side of a course."""
    drawn, side = draw_alignment(rng), rng.choice([-1.0, 1.0])
    least = side * min((abs(radius) for _, radius in arcs), default=np.inf)
    return Course(drawn.yaw, least, grade, drawn.offset, tuple((length, side * radius) for length, radius in arcs))


def s_curve(rng: np.random.Generator) -> Cloud:
    """Return the arch in two opposite bends of 60 m radius."""
    return finish(rng, bore(_course(rng, ((30.0, 60.0), (30.0, -60.0)))))


def hairpin(rng: np.random.Generator) -> Cloud:
    """Return the arch of 110 m that turns back through 180° at 18 m radius: its legs are 30 m of rock apart."""
    arcs = ((26.0, np.inf), (18.0 * np.pi, 18.0), (28.0, np.inf))
    return finish(rng, bore(_course(rng, arcs), length=sum(length for length, _ in arcs)))


def steep(rng: np.random.Generator) -> Cloud:
    """Return the arch at a grade of 12 %, as a ramp has it."""
    site = bore(replace(draw_alignment(rng), grade=rng.choice([-0.12, 0.12])))
    return finish(rng, site.telling(ends=(0.0, LENGTH * np.hypot(1.0, 0.12))))


def section_change(rng: np.random.Generator) -> Cloud:
    """Return an arch of 5.5 m that is 8 m wide and 6.8 m high from its middle on."""
    wide, half = Arch(8.0, 6.8, 2.75), LENGTH / 2
    site = bore(draw_alignment(rng))
    both = replace(site, air=prism(site.arch.outline(), 0.0, half + 0.01) + prism(wide.outline(), half, LENGTH))
    seen = both.scanned(rng)
    station = np.arange(0.0, LENGTH + 1e-9, 0.25)
    at, left, up = seen.local.T
    arches = [np.abs(arch.depth(left, up)) < 0.005 for arch in (site.arch, wide)]
    lining = np.where(at < half, *arches) & (up > 0.5) & (np.abs(at - LENGTH / 2) < half - 2.0)
    step = np.abs(station - half) < 1.0  # neither the one nor the other
    sizes = {
        name: np.where(step, np.nan, np.where(station < half, getattr(site.arch, name), getattr(wide, name)))
        for name in ("width", "height")
    }
    truth = both.telling(cause=("section", "step", "wider", "widens", *OPENINGS), **sizes).truth(rng, seen)
    rows = np.flatnonzero(lining)
    truth["wall"] = seen.exact[np.sort(rng.choice(rows, min(6000, len(rows)), replace=False))]
    return seen.point, truth


def junction(angle: float) -> Callable[[np.random.Generator], Cloud]:
    """Return a maker of the arch with a tunnel of the same arch that leaves it under an angle in plan, rad."""

    def make(rng: np.random.Generator) -> Cloud:
        site, at, side = bore(draw_alignment(rng)), rng.uniform(24.0, 34.0), float(rng.choice([-1.0, 1.0]))
        run, turn = 30.0, side * np.degrees(angle)
        branch = prism(site.arch.outline(), 0.0, run).rotate((0.0, 0.0, turn)).translate((at, 0.0, 0.0))
        along = np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn)), 0.0])
        stands = np.array([at, 0.0, HEIGHT]) + np.arange(6.0, run, 6.0)[:, None] * along

        def sky(local: np.ndarray) -> np.ndarray:
            beyond = (local - (at, 0.0, 0.0)) @ along > run - 1e-3
            mouths = (local[:, 0] < 1e-3) | (local[:, 0] > LENGTH - 1e-3)
            return np.where(np.abs(local[:, 1]) < 2.76, mouths, beyond)

        wide = 5.5 / np.sin(angle)
        site = replace(site, air=site.air + branch, sky=sky, tripods=np.concatenate([site.tripods, stands]))
        # Where the branch opens there is no wall on its side, and so no width.
        gone = (at - wide, at + wide + 3.0 / np.tan(angle))
        station = np.arange(0.0, LENGTH + 1e-9, 0.25)
        width = np.where((station > gone[0]) & (station < gone[1]), np.nan, site.arch.width)
        told = {"width": width, "must_say": True, "trouble": gone, "cause": OPENINGS, "bulge": ["aside"]}
        return finish(rng, site.telling(**told))

    return make


def two_passes(apart: float) -> Callable[[np.random.Generator], Cloud]:
    """Return a maker of the arch scanned twice, the second pass `apart` m aside and half of it up."""

    def make(rng: np.random.Generator) -> Cloud:
        site = bore(draw_alignment(rng)).telling(cause=_DOUBLED, must_say=True)
        first, second = (replace(site, tripods=site.tripods[k::2]).scanned(rng, 0.08) for k in (0, 1))
        points, truth = finish(rng, site, first)
        return np.concatenate([points, second.point + site.alignment.place(np.array([[0.0, apart, apart / 2]]))[0]
                               - site.alignment.place(np.zeros((1, 3)))[0]]), truth  # fmt: skip

    return make


def few_stations(rng: np.random.Generator) -> Cloud:
    """Return the arch scanned from three tripods 25 m apart: far from each the points lie thin and slanting."""
    site = bore(draw_alignment(rng))
    stands = np.array([[5.0, 0.3, HEIGHT], [30.0, 0.3, HEIGHT], [55.0, 0.3, HEIGHT]])
    return finish(rng, replace(site, tripods=stands).telling(cause=UNSEEN))


def profiles(rng: np.random.Generator) -> Cloud:
    """Return the arch as a profile scanner on a trolley leaves it: slanting rows of points, 80 cm apart."""
    site = bore(draw_alignment(rng))
    seen = site.scanned(rng, 0.02)
    slanted = seen.local[:, 0] + 0.15 * seen.local[:, 1]
    rows = np.abs(slanted / 0.8 - np.rint(slanted / 0.8)) * 0.8 < 0.012
    points, truth = finish(
        rng, site, replace(seen, local=seen.local[rows], exact=seen.exact[rows], point=seen.point[rows])
    )
    return points, truth


def wet_floor(rng: np.random.Generator) -> Cloud:
    """Return the arch with water on half of its floor: what is above appears again below it, a fifth as dense."""
    site = bore(draw_alignment(rng)).telling(cause=("floor", "below", "mirror", *CLEARED))
    points, truth = finish(rng, site)
    whole = site.scanned(rng)
    mirrored = whole.local[(rng.uniform(size=len(whole.local)) < 0.2) & (whole.local[:, 2] > 0.05)] * (1.0, 1.0, -1.0)
    under = np.abs(mirrored[:, 1]) < 1.4
    return np.concatenate([points, site.alignment.place(mirrored[under])]), truth


def pipe(rng: np.random.Generator) -> Cloud:
    """Return a round pipe of 2.6 m."""
    arch = Arch(2.6, 2.6, 1.3)
    turn = np.linspace(0.0, 2.0 * np.pi, 97)[:-1]
    circle = np.stack([1.3 * np.cos(turn), 1.3 + 1.3 * np.sin(turn)], axis=1)
    site = bore(draw_alignment(rng), arch)
    site = replace(site, air=prism(circle, 0.0, LENGTH), tripods=site.tripods * (1.0, 0.3, 0.7))
    points, truth = finish(rng, site.telling(track="none"))
    return points, truth


def hall(rng: np.random.Generator) -> Cloud:
    """Return the arch with a hall of 14 × 16 × 7 m in its middle."""
    site = bore(draw_alignment(rng))
    at = rng.uniform(20.0, 26.0)
    stands = np.array([[at + s, left, HEIGHT] for s in (4.0, 12.0) for left in (-4.0, 4.0)])
    site = replace(site, air=site.air + box((at, -7.0, 0.0), (at + 16.0, 7.0, 7.0)),
                   tripods=np.concatenate([site.tripods, stands]))  # fmt: skip
    station = np.arange(0.0, LENGTH + 1e-9, 0.25)
    there = (station > at - 2.0) & (station < at + 18.0)
    sizes = {name: np.where(there, np.nan, 5.5) for name in ("width", "height")}
    told = {**sizes, "must_say": True, "trouble": (at, at + 16.0), "cause": ("hall", "room", *OPENINGS)}
    return finish(rng, site.telling(**told))


def rounded(rng: np.random.Generator) -> Cloud:
    """Return the arch at 5,400 km north of the origin, as 32-bit numbers keep it: on a grid of half a metre."""
    drawn = draw_alignment(rng)
    site = bore(replace(drawn, offset=(412_000.0, 5_400_000.0, drawn.offset[2]))).telling(cause=_ROUNDED)
    points, truth = finish(rng, site)
    return points.astype(np.float32).astype(float), truth


def origin_rows(rng: np.random.Generator) -> Cloud:
    """Return the arch, each point of which stands three times, with 3 % of rows 0 0 0, as scanners write no return."""
    points, truth = finish(rng, bore(draw_alignment(rng)).telling(cause=CLEARED))
    return np.concatenate([np.repeat(points, 3, axis=0), np.zeros((len(points) // 10, 3))]), truth


def rock(rng: np.random.Generator) -> Cloud:
    """Return a blasted bore whose rock stands out and back by 12 cm rms over half a metre."""
    site = bore(draw_alignment(rng), Arch(6.0, 6.0, 3.0), length=40.0)
    waves = rng.normal(0.0, 1.0 / 0.5, (24, 3))
    phases = rng.uniform(0.0, 2.0 * np.pi, 24)

    def rough(vertex: np.ndarray) -> np.ndarray:
        """Moves the wall along the radius; the floor and the mouths stay."""
        depth = 0.12 * np.sqrt(2.0 / 24) * np.cos(vertex @ waves.T + phases).sum(axis=1)
        spoke = vertex - (0.0, 0.0, 3.0) * np.ones((len(vertex), 1))
        spoke[:, 0] = 0.0
        spoke /= np.maximum(np.linalg.norm(spoke, axis=1, keepdims=True), 1e-9)
        return vertex + np.where(vertex[:, 2:] > 0.02, depth[:, None] * spoke, 0.0)

    air = site.air.refine_to_length(0.25).warp_batch(rough)
    whole = replace(site, air=air)
    seen = whole.scanned(rng)
    truth = whole.telling(bulge=["width", "height", "aside"], band=(-2.0, -0.2)).truth(rng, seen)
    at, _, up = seen.local.T
    rows = np.flatnonzero((up > 0.5) & (at > 2.0) & (at < 38.0))
    truth["wall"] = seen.exact[np.sort(rng.choice(rows, 6000, replace=False))]
    return seen.point, truth


def floor_step(rng: np.random.Generator) -> Cloud:
    """Return the arch whose floor lies 40 cm higher from its middle on."""
    site = bore(draw_alignment(rng))
    site = site.without(box((LENGTH / 2, -4.0, -0.1), (LENGTH + 1.0, 4.0, 0.4)))
    station = np.arange(0.0, LENGTH + 1e-9, 0.25)
    high = station > LENGTH / 2
    step = np.abs(station - LENGTH / 2) < 1.0
    told = {
        "axis_above_floor": np.where(step, np.nan, np.where(high, 2.35, 2.75)),
        "height": np.where(step, np.nan, np.where(high, 5.1, 5.5)),
        "cause": ("floor", "step"),
    }
    return finish(rng, replace(site, tripods=site.tripods + np.array([0.0, 0.0, 0.3])).telling(**told))


def culvert(rng: np.random.Generator) -> Cloud:
    """Return an arched culvert of 1.2 × 1.6 m, scanned from a low tripod every 3 m."""
    site = bore(draw_alignment(rng), Arch(1.2, 1.6, 1.0), length=30.0)
    station = np.arange(1.0, 29.5, 3.0)
    stands = np.stack([station, 0.1 + 0 * station, np.full_like(station, 0.8)], axis=1)
    return finish(rng, replace(site, tripods=stands).telling(track="none", cause=("narrow",)))


def three_lanes(rng: np.random.Generator) -> Cloud:
    """Return a road bore of 16 × 9.5 m."""
    return finish(rng, bore(draw_alignment(rng), Arch(16.0, 9.5, 2.0)).telling(track="none"))


def mine_bend(rng: np.random.Generator) -> Cloud:
    """Return a drift of 4 m that turns through 90° at 10 m radius, as in a mine."""
    arcs = ((18.0, np.inf), (5.0 * np.pi, 10.0), (18.0, np.inf))
    return finish(rng, bore(_course(rng, arcs), Arch(4.0, 4.0, 2.0), length=sum(length for length, _ in arcs)))


def two_pieces(rng: np.random.Generator) -> Cloud:
    """Return an arch of 120 m of which nobody scanned 30 m: 35 m before them, 55 m behind them."""
    site = bore(draw_alignment(rng), length=120.0)
    site = site.telling(span=(67.0, 118.0), ends=(65.0, 120.0), cause=(*UNSEEN, "beyond"), must_say=True)
    whole = site.scanned(rng)
    seen = (whole.local[:, 0] < 35.0) | (whole.local[:, 0] > 65.0)
    return choose(whole, seen).point, site.truth(rng, choose(whole, seen))


def twin(rng: np.random.Generator) -> Cloud:
    """Return two arches 14 m from axis to axis, of 60 and 50 m, joined by a passage 2 m wide."""
    first = bore(draw_alignment(rng))
    low, high, at = 5.0, 55.0, rng.uniform(22.0, 36.0)
    second = prism(first.arch.outline() + np.array([14.0, 0.0]), low, high)
    passage = box((at, 2.0, 0.0), (at + 2.0, 12.0, 2.4))
    stands = first.tripods[(first.tripods[:, 0] > low + 1) & (first.tripods[:, 0] < high - 1)] + np.array([0, 14.0, 0])
    middle = np.array([[at + 1.0, left, HEIGHT] for left in (5.0, 9.0)])

    def sky(local: np.ndarray) -> np.ndarray:
        aside = local[:, 1] > 7.0
        start, end = np.where(aside, low, 0.0), np.where(aside, high, LENGTH)
        return (local[:, 0] < start + 1e-3) | (local[:, 0] > end - 1e-3)

    both = replace(first, air=first.air + second + passage, tripods=np.concatenate([first.tripods, stands, middle]),
                   sky=sky)  # fmt: skip
    told = {"must_say": True, "trouble": (at, at + 2.0), "cause": (*OPENINGS, "another tunnel"), "bulge": ["aside"]}
    return finish(rng, both.telling(**told))
