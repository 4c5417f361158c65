"""Design elements fitted to an axis: lines, arcs and clothoids in plan, grades and parabolas in profile.

A fit with many knots is thinned to one with too few. Knots are then put in where they take enough off the misfit, all
numbers and places being fitted anew each time, and taken out where they do not. At last neighbouring values are made
equal, or zero, where that costs next to nothing. Enough is more than noise would save by chance, with noise taken from
the points: an axis out of a smoothed cloud errs alike over some metres, one of measured rings from ring to ring.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from scene.report.noise import Spread, correlated_noise, find_spread
from scene.report.profiles import (
    LEAST_ELEMENT,
    HeightTarget,
    PlanTarget,
    Profile,
    Target,
    Tie,
    adjust,
    cumulate,
    jacobian,
    knot_costs,
    normal_equations,
    on_neighbours,
    pack,
    renumber,
    unpack,
)

_FIRST_SPACING = 8.0  # m between the knots of the first fit
_FEWEST = 2.5  # points to a knot of the first fit
_COARSE = 0.003  # m; the first fit is thinned by at least this much, for what is missing is put in again
_STRAIGHT = 2e-5  # 1/m; a curve of a radius above 50 km is a line
_LEAST_NOISE = 2e-5  # m; no survey is finer than this
_WORTH = 0.1  # a knot must take this share of the tolerance, squared, off the mean square
_STAGE = 30.0  # from one price of a knot to the next lower one, on the way to the last
_PLACES = 2.0  # m between the places at which a further knot is thought of
_TRIES = 4  # knots whose removal, or places whose knot, is tried at a time


@dataclass(frozen=True)
class Element:
    """One element of an alignment.

    Attributes:
        kind: `line`, `arc` or `clothoid` in plan; `grade` or `parabola` in profile.
        start: Station at which it begins, m.
        end: Station at which it ends, m.
        first: Curvature (1/m, to the left positive) or grade at its beginning.
        last: The same at its end.
    """

    kind: str
    start: float
    end: float
    first: float
    last: float

    @property
    def length(self) -> float:
        """Length, m."""
        return self.end - self.start


@dataclass(frozen=True)
class Fit:
    """Elements of an axis, and how well they meet it.

    Attributes:
        profile: The elements as one quantity.
        elements: The elements, in order.
        spread: What the points leave open of each element.
        residual: Distance of the points to the left of the plan, or above the profile, m.
        station: Station of each point, m.
    """

    profile: Profile
    elements: tuple[Element, ...]
    spread: tuple[Spread, ...]
    residual: Float[np.ndarray, " n"]
    station: Float[np.ndarray, " n"]

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, m."""
        return float(np.sqrt(np.mean(self.residual**2)))


def fit_plan(points: Float[np.ndarray, "n 2"], station: Float[np.ndarray, " n"], tolerance: float | None = None) -> Fit:
    """Fit lines, arcs and clothoids to an axis in plan.

    Args:
        points: Points of the axis in order, m.
        station: Their stations, growing: arc length in plan, m.
        tolerance: Root mean square by which fewer elements may be further from the points than many, m; 0 asks for
            as many as noise that is independent from point to point does not explain, `None` for as many as noise
            that errs alike over some metres does not.

    Raises:
        ValueError: There are fewer than ten points, or they lie on less than 20 m.
    """
    chord = points[min(5, len(points) - 1)] - points[0]
    heading = np.arctan2(chord[1], chord[0])
    across = np.array([-np.sin(heading), np.cos(heading)])
    return _fit(
        PlanTarget(points, station, across), np.array([*points[0], heading]), tolerance, ("line", "arc", "clothoid")
    )


def fit_profile(
    height: Float[np.ndarray, " n"], station: Float[np.ndarray, " n"], tolerance: float | None = None
) -> Fit:
    """Fit straight grades and parabolas to heights over station; as `fit_plan`.

    Raises:
        ValueError: There are fewer than ten points, or they lie on less than 20 m.
    """
    return _fit(HeightTarget(height, station), height[:1], tolerance, ("grade", "grade", "parabola"))


def _first(station: Float[np.ndarray, " n"], start: Float[np.ndarray, " i"]) -> Profile:
    if len(station) < 10 or station[-1] - station[0] < 20.0:
        raise ValueError(f"elements need an axis of 20 m and ten points, got {len(station)} points")
    spacing = max(_FIRST_SPACING, _FEWEST * float(np.median(np.diff(station))))
    count = max(3, round((station[-1] - station[0]) / spacing) + 1)
    knot = np.linspace(station[0], station[-1], count)
    return Profile(knot, np.zeros(count), np.asarray(start, float))


def _fit(
    target: PlanTarget | HeightTarget, start: Float[np.ndarray, " i"], tolerance: float | None,
    kinds: tuple[str, str, str],
) -> Fit:  # fmt: skip
    """Find the knots, make values equal where they can be, and name the elements."""
    first = _first(target.station, start)
    dense = adjust(first, np.arange(len(first.knot)), target, move=False)
    allowed = _square(dense, target) / len(target.station) + max(tolerance or 0.0, _COARSE) ** 2
    thin = _thin_linear(dense, target, allowed)
    thin = adjust(thin, np.arange(len(thin.knot)), target)
    price = _price(target, dense, tolerance)
    # The dearest knots first: put in all at once, they settle where none of them can leave alone.
    profile, stage = thin, max(price, _WORTH * len(target.station) * _COARSE**2)
    while True:
        profile = _take_out(_put_in(profile, target, stage), target, stage)
        if stage <= price:
            break
        stage = max(price, stage / _STAGE)
    profile, tie = _equalise(profile, target, price)
    elements = _name(profile, tie, kinds)
    ends = np.isin(profile.knot, [elements[0].start, *(element.end for element in elements)])
    spread = find_spread(replace(profile, knot=profile.knot[ends], value=profile.value[ends]), tie[ends], target)
    return Fit(profile, elements, spread, target.miss(profile), target.station)


def _square(profile: Profile, target: Target) -> float:
    """Return the sum of squares of the misses, m²."""
    return float(np.sum(target.miss(profile) ** 2))


def _price(target: PlanTarget | HeightTarget, dense: Profile, tolerance: float | None) -> float:
    """Return the sum of squares that a knot must save, m².

    That is what chance saves with two more numbers by Schwarz's criterion, and a share of the tolerance. Without one,
    noise is what the dense fit leaves: elements are longer than its knots are apart.
    """
    n = len(target.station)
    if tolerance is None:
        sigma, alike = correlated_noise(target.miss(dense), len(dense.knot) + len(dense.start))
        return 2.0 * np.log(n / alike) * alike * max(sigma, _LEAST_NOISE) ** 2
    noise = max(target.noise(), _LEAST_NOISE)
    return max(2.0 * np.log(n) * noise**2, _WORTH * n * tolerance**2)


def _put_in(profile: Profile, target: Target, price: float) -> Profile:
    """Put in knots, the most useful first, as long as each is worth its price."""
    while True:
        before = _square(profile, target)
        for place in _useful_places(profile, target):
            trial = _with(profile, place)
            free = np.arange(len(trial.knot))
            # Values first: from there on moving knots can only gain, whatever they run into.
            trial = adjust(adjust(trial, free, target, move=False), free, target)
            if _square(trial, target) < before - price:
                profile = trial
                break
        else:
            return profile


def _useful_places(profile: Profile, target: Target) -> Float[np.ndarray, " t"]:
    """Return places at which a knot would save most, by the linear problem."""
    place = np.arange(profile.knot[0] + LEAST_ELEMENT, profile.knot[-1] - LEAST_ELEMENT, _PLACES)
    place = place[np.abs(place[:, None] - profile.knot).min(axis=1) > LEAST_ELEMENT]
    if not len(place):
        return place
    node = np.linspace(profile.knot[0], profile.knot[-1], round(profile.knot[-1] - profile.knot[0]) + 2)
    after = np.searchsorted(profile.knot, place)
    low, high = profile.knot[after - 1], profile.knot[after]
    hat = np.clip(np.minimum((node[:, None] - low) / (place - low), (high - node[:, None]) / (high - place)), 0.0, None)
    new = target.columns(profile, node, cumulate(hat, node))
    old = jacobian(profile, np.arange(len(profile.knot)), target, move=True)
    basis = np.linalg.qr(old / np.maximum(np.linalg.norm(old, axis=0), 1e-12))[0]
    own, miss = (part - basis @ (basis.T @ part) for part in (new, target.miss(profile)))
    size = np.sum(own**2, axis=0)
    told = size > 1e-9 * np.sum(new**2, axis=0)  # what the present numbers cannot imitate
    gain = np.where(told, (own.T @ miss) ** 2 / np.maximum(size, 1e-30), 0.0)
    return place[np.argsort(-gain)[:_TRIES]]


def _with(profile: Profile, place: float) -> Profile:
    j = int(np.searchsorted(profile.knot, place))
    value = float(profile.at(np.array([place]))[0])
    return replace(profile, knot=np.insert(profile.knot, j, place), value=np.insert(profile.value, j, value))


def _without(profile: Profile, j: int) -> Profile:
    return replace(profile, knot=np.delete(profile.knot, j), value=np.delete(profile.value, j))


def _thin_linear(profile: Profile, target: Target, allowed: float) -> Profile:
    """Take out knots, the cheapest first and without moving the others, while the mean square stays allowed.

    Curvature is small, so the problem is linear in start and values, and is set up once.
    """
    normal, right = normal_equations(profile, target)
    spare = (allowed - float(np.mean(target.miss(profile) ** 2))) * len(target.station)
    start, first, spent = profile.start, len(profile.start), 0.0
    while len(profile.knot) > 3:
        inverse = np.linalg.pinv(normal, rcond=1e-14, hermitian=True)
        numbers = inverse @ right
        profile = Profile(profile.knot, numbers[first:], start + numbers[:first])
        costs = knot_costs(profile, inverse)
        j = int(np.argmin(costs))
        spent += float(costs[j])
        if spent > spare:
            break
        # The value at the knot becomes that between its neighbours.
        fold = np.delete(np.eye(len(normal)), first + j, axis=1)
        share = np.delete(on_neighbours(profile, j), j)
        fold[first + j, first:] = share
        normal, right = fold.T @ normal @ fold, fold.T @ right
        profile = _without(profile, j)
    return adjust(profile, np.arange(len(profile.knot)), target, move=False)


def _take_out(profile: Profile, target: Target, price: float) -> Profile:
    """Take out knots that, with the others moved, are not worth their price."""
    while len(profile.knot) > 2:
        most = _square(profile, target) + price
        for trial in _thinner(profile, target):
            if _square(trial, target) <= most:
                profile = trial
                break
        else:
            return profile
    return profile


def _thinner(profile: Profile, target: Target) -> Iterator[Profile]:
    """Yield the profile without one of its knots, those first that cost least by the linear problem."""
    inverse = np.linalg.pinv(normal_equations(profile, target)[0], rcond=1e-14, hermitian=True)
    for j in np.argsort(knot_costs(profile, inverse))[:_TRIES]:
        if 0 < j < len(profile.knot) - 1:
            yield adjust(_without(profile, int(j)), np.arange(len(profile.knot) - 1), target)


def _equalise(profile: Profile, target: Target, price: float) -> tuple[Profile, Tie]:
    """Make neighbouring values equal, and small ones zero, the cheapest first, where that costs less than a price."""
    tie = np.arange(len(profile.knot))
    refused: set[tuple[int, ...]] = set()
    while True:
        most = _square(profile, target) + price
        for trial_tie in _next_ties(profile, tie):
            if tuple(trial_tie) in refused:
                continue
            trial = adjust(unpack(pack(profile, trial_tie, True), profile, trial_tie, True), trial_tie, target)
            if _square(trial, target) <= most:
                profile, tie = trial, trial_tie
                break
            refused.add(tuple(trial_tie))
        else:
            return profile, tie


def _next_ties(profile: Profile, tie: Tie) -> list[Tie]:
    """Return the ties with one more condition, those that change the values least first."""
    found = []
    for j in range(len(tie) - 1):
        if tie[j] != tie[j + 1]:
            change = abs(profile.value[j + 1] - profile.value[j]) * (profile.knot[j + 1] - profile.knot[j])
            joined = np.where(tie == tie[j + 1], tie[j], tie) if tie[j + 1] >= 0 else np.where(tie == tie[j], -1, tie)
            found.append((change, joined))
    for group in range(tie.max() + 1):
        mine = tie == group
        if mine.sum() > 1 or mine[0] or mine[-1]:
            found.append(
                (abs(profile.value[mine][0]) * float(np.ptp(profile.knot[mine]) + 1.0), np.where(mine, -1, tie))
            )
    return [renumber(one) for _, one in sorted(found, key=lambda pair: pair[0])]


def _name(profile: Profile, tie: Tie, kinds: tuple[str, str, str]) -> tuple[Element, ...]:
    """Return the elements between the knots; neighbours of one value are one element."""
    straight, constant, sloping = kinds
    elements: list[Element] = []
    for j in range(len(tie) - 1):
        first, last = profile.value[j : j + 2]
        level = tie[j] == tie[j + 1]
        kind = sloping if not level else straight if abs(first) < _STRAIGHT else constant
        start = profile.knot[j]
        if level and elements and elements[-1].kind == kind and elements[-1].last == first:
            start = elements.pop().start
        elements.append(Element(kind, float(start), float(profile.knot[j + 1]), float(first), float(last)))
    return tuple(elements)
