"""Design elements fitted to an axis: lines, arcs and clothoids in plan, grades and parabolas in profile.

Both are one problem. Curvature (or grade) is linear between knots: where it is constant there is an arc or a line (a
straight grade), where it slopes a clothoid (a parabola). A fit with many knots is thinned to the fewest that keep the
axis within a tolerance; then neighbouring values are made equal, or zero, where that costs next to nothing.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import interp1d

_STEP = 1.0  # m between the nodes of the integration
_FIRST_SPACING = 8.0  # m between the knots of the first fit
_LEAST_ELEMENT = 4.0  # m
_ROUNDS = 30  # of Gauss-Newton
_STRAIGHT = 2e-5  # 1/m; a curve of a radius above 50 km is a line


@dataclass(frozen=True)
class Profile:
    """A quantity along the axis that is linear between knots: curvature in plan (1/m), or grade (1).

    Attributes:
        knot: Stations of the knots, growing, m.
        value: Value at each knot.
        start: What the integration begins with: x, y (m) and heading (rad) in plan; height (m) in profile.
    """

    knot: Float[np.ndarray, " k"]
    value: Float[np.ndarray, " k"]
    start: Float[np.ndarray, " i"]

    def at(self, station: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return the value at stations."""
        return np.interp(station, self.knot, self.value)

    def integral(self, station: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return the exact integral from the first knot."""
        width = np.diff(self.knot)
        slope = np.diff(self.value) / width
        sums = np.concatenate([[0.0], np.cumsum(0.5 * (self.value[1:] + self.value[:-1]) * width)])
        i = np.clip(np.searchsorted(self.knot, station, side="right") - 1, 0, len(width) - 1)
        beyond = station - self.knot[i]
        return sums[i] + (self.value[i] + 0.5 * slope[i] * beyond) * beyond

    def plan(self, station: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
        """Return positions (m) and headings (rad) of an axis of this curvature."""
        first, last = self.knot[0], self.knot[-1]
        node = np.linspace(first, last, max(3, int(np.ceil((last - first) / _STEP)) + 1))
        along = np.concatenate([np.zeros((1, 2)), np.cumsum(self._chord(node[:-1], node[1:]), axis=0)])
        i = np.clip(np.searchsorted(node, station, side="right") - 1, 0, len(node) - 1)
        heading = self.start[2] + self.integral(station)
        return self.start[:2] + along[i] + self._chord(node[i], station), heading

    def _chord(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return the way between two stations by Simpson's rule: to micrometres over half a metre."""
        heading = self.start[2] + np.stack([self.integral(s) for s in (start, 0.5 * (start + end), end)])
        weight = np.array([1.0, 4.0, 1.0])[:, None]
        mean = np.stack([(weight * np.cos(heading)).sum(axis=0), (weight * np.sin(heading)).sum(axis=0)], axis=-1)
        return (end - start)[:, None] * mean / 6.0

    def height(self, station: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return heights of a profile of this grade, m."""
        return self.start[0] + self.integral(station)


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
        residual: Distance of the points to the left of the plan, or above the profile, m.
        station: Station of each point, m.
    """

    profile: Profile
    elements: tuple[Element, ...]
    residual: Float[np.ndarray, " n"]
    station: Float[np.ndarray, " n"]

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, m."""
        return float(np.sqrt(np.mean(self.residual**2)))


class Target(Protocol):
    """The points that a profile is fitted to."""

    @property
    def station(self) -> Float[np.ndarray, " n"]:
        """Station of each point, m."""

    def miss(self, profile: Profile) -> Float[np.ndarray, " n"]:
        """Return the distance of each point from the profile, m."""

    def start_columns(self, profile: Profile) -> Float[np.ndarray, "n i"]:
        """Return the derivative of each point's place on the profile by the numbers of its start."""

    def columns(
        self, profile: Profile, node: Float[np.ndarray, " m"], turned: Float[np.ndarray, "m p"]
    ) -> Float[np.ndarray, "n p"]:
        """Return that by numbers which change the integral of the quantity at the nodes by `turned`."""


@dataclass(frozen=True)
class _Plan:
    """Points of an axis in plan, m, at their stations; its start may move along `across` alone.

    Moved along the axis, together with all knots, it would change nothing that is measured.
    """

    points: Float[np.ndarray, "n 2"]
    station: Float[np.ndarray, " n"]
    across: Float[np.ndarray, "2"]

    def miss(self, profile: Profile) -> Float[np.ndarray, " n"]:
        at, heading = profile.plan(self.station)
        across = self.points - at
        return across[:, 1] * np.cos(heading) - across[:, 0] * np.sin(heading)

    def start_columns(self, profile: Profile) -> Float[np.ndarray, "n 3"]:
        at, heading = profile.plan(self.station)
        moved = at - profile.start[:2]
        turned = moved[:, 0] * np.cos(heading) + moved[:, 1] * np.sin(heading)
        aside = self.across[1] * np.cos(heading) - self.across[0] * np.sin(heading)
        return np.stack([self.across[0] * aside, self.across[1] * aside, turned], axis=1)

    def columns(
        self, profile: Profile, node: Float[np.ndarray, " m"], turned: Float[np.ndarray, "m p"]
    ) -> Float[np.ndarray, "n p"]:
        bearing = profile.start[2] + profile.integral(node)
        aside = [_cumulate(part[:, None] * turned, node) for part in (-np.sin(bearing), np.cos(bearing))]
        x, y = (interp1d(node, part, axis=0)(self.station) for part in aside)
        heading = (profile.start[2] + profile.integral(self.station))[:, None]
        return y * np.cos(heading) - x * np.sin(heading)


@dataclass(frozen=True)
class _Height:
    """Heights of an axis, m, at their stations."""

    height: Float[np.ndarray, " n"]
    station: Float[np.ndarray, " n"]

    def miss(self, profile: Profile) -> Float[np.ndarray, " n"]:
        return self.height - profile.height(self.station)

    def start_columns(self, profile: Profile) -> Float[np.ndarray, "n 1"]:
        del profile
        return np.ones((len(self.station), 1))

    def columns(
        self, profile: Profile, node: Float[np.ndarray, " m"], turned: Float[np.ndarray, "m p"]
    ) -> Float[np.ndarray, "n p"]:
        del profile
        return interp1d(node, turned, axis=0)(self.station)


def fit_plan(points: Float[np.ndarray, "n 2"], station: Float[np.ndarray, " n"], tolerance: float = 0.003) -> Fit:
    """Fit lines, arcs and clothoids to an axis in plan.

    Args:
        points: Points of the axis in order, m.
        station: Their stations, growing: arc length in plan, m.
        tolerance: Root mean square by which fewer elements may be further from the points than many, m.

    Raises:
        ValueError: There are fewer than ten points, or they lie on less than 20 m.
    """
    chord = points[min(5, len(points) - 1)] - points[0]
    heading = np.arctan2(chord[1], chord[0])
    across = np.array([-np.sin(heading), np.cos(heading)])
    return _fit(_Plan(points, station, across), np.array([*points[0], heading]), tolerance, ("line", "arc", "clothoid"))


def fit_profile(height: Float[np.ndarray, " n"], station: Float[np.ndarray, " n"], tolerance: float = 0.003) -> Fit:
    """Fit straight grades and parabolas to heights over station; as `fit_plan`.

    Raises:
        ValueError: There are fewer than ten points, or they lie on less than 20 m.
    """
    return _fit(_Height(height, station), height[:1], tolerance, ("grade", "grade", "parabola"))


def _first(station: Float[np.ndarray, " n"], start: Float[np.ndarray, " i"]) -> Profile:
    if len(station) < 10 or station[-1] - station[0] < 20.0:
        raise ValueError(f"elements need an axis of 20 m and ten points, got {len(station)} points")
    count = max(3, round((station[-1] - station[0]) / _FIRST_SPACING) + 1)
    knot = np.linspace(station[0], station[-1], count)
    return Profile(knot, np.zeros(count), np.asarray(start, float))


Tie = Int[np.ndarray, " k"]  # number of the value at each knot; knots that share one are equal, -1 is zero


def _fit(target: _Plan | _Height, start: Float[np.ndarray, " i"], tolerance: float, kinds: tuple[str, str, str]) -> Fit:
    """Thin the knots of a fit, make its values equal where they can be, and name its elements."""
    first = _first(target.station, start)
    dense = _adjust(first, np.arange(len(first.knot)), target, move=False)
    allowed = float(np.mean(target.miss(dense) ** 2)) + tolerance**2
    thin = _thin_linear(dense, target, allowed)
    thin = _thin(_adjust(thin, np.arange(len(thin.knot)), target), target, allowed)
    profile, tie = _equalise(thin, target, allowed)
    return Fit(profile, _name(profile, tie, kinds), target.miss(profile), target.station)


def _pack(profile: Profile, tie: Tie, move: bool) -> Float[np.ndarray, " p"]:
    groups = [profile.value[tie == group].mean() for group in range(tie.max() + 1)]
    return np.concatenate([profile.start, groups, profile.knot[1:-1] if move else []])


def _unpack(numbers: Float[np.ndarray, " p"], profile: Profile, tie: Tie, move: bool) -> Profile:
    first, count = len(profile.start), tie.max() + 1
    value = np.where(tie < 0, 0.0, numbers[first + np.maximum(tie, 0)]) if count else np.zeros(len(tie))
    knot = profile.knot
    if move:
        inner = numbers[first + count :]
        knot = np.concatenate([knot[:1], inner, knot[-1:]])
    return Profile(knot, value, numbers[:first])


def _jacobian(profile: Profile, tie: Tie, target: Target, move: bool) -> Float[np.ndarray, "n p"]:
    """Return the derivatives of the misses: start, values of the ties and, with `move`, inner knots."""
    node = np.linspace(profile.knot[0], profile.knot[-1], round((profile.knot[-1] - profile.knot[0]) / _STEP) + 2)
    before, after = _hats(profile.knot, node)
    slope = np.diff(profile.value) / np.diff(profile.knot)
    parts = [(before + after) @ (tie[:, None] == np.arange(tie.max() + 1))]
    if move:  # a knot that moves on lowers a rising line on both of its sides
        parts.append(-(before[:, 1:-1] * slope[:-1] + after[:, 1:-1] * slope[1:]))
    turned = _cumulate(np.hstack(parts), node)
    return -np.hstack([target.start_columns(profile), target.columns(profile, node, turned)])


def _hats(knot: np.ndarray, node: np.ndarray) -> tuple[Float[np.ndarray, "m k"], Float[np.ndarray, "m k"]]:
    """Return the rising and the falling half of each knot's hat at the nodes."""
    i = np.clip(np.searchsorted(knot, node, side="right") - 1, 0, len(knot) - 2)
    share = (node - knot[i]) / (knot[i + 1] - knot[i])
    rising, falling = np.zeros((2, len(node), len(knot)))
    row = np.arange(len(node))
    rising[row, i + 1], falling[row, i] = share, 1.0 - share
    return rising, falling


def _cumulate(values: Float[np.ndarray, "m p"], node: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m p"]:
    """Return the integral from the first node."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(node)[:, None]
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])


def _adjust(profile: Profile, tie: Tie, target: Target, *, move: bool = True, rounds: int = _ROUNDS) -> Profile:
    """Fit start, values and, with `move`, the places of the knots, by damped Gauss-Newton steps."""
    damping, cost = 1e-8, float(np.sum(target.miss(profile) ** 2))
    for _ in range(rounds):
        matrix = _jacobian(profile, tie, target, move)
        scale = np.maximum(np.linalg.norm(matrix, axis=0), 1e-12)
        normal, right = (matrix / scale).T @ (matrix / scale), -(matrix / scale).T @ target.miss(profile)
        for _ in range(6):
            step = np.linalg.solve(normal + damping * np.eye(len(scale)), right) / scale
            trial = _stepped(profile, tie, step, move)
            lower = float(np.sum(target.miss(trial) ** 2))
            if lower < cost:
                break
            damping = max(30.0 * damping, 1e-8)
        else:
            return profile
        gain, profile, cost = (cost - lower) / max(cost, 1e-30), trial, lower
        damping = max(0.1 * damping, 1e-10)
        if gain < 1e-5:
            return profile
    return profile


def _stepped(profile: Profile, tie: Tie, step: Float[np.ndarray, " p"], move: bool) -> Profile:
    """Return the profile after a step; knots go at most so far that each element keeps its least length."""
    numbers = _pack(profile, tie, move) + step
    trial = _unpack(numbers, profile, tie, move)
    gap = np.diff(profile.knot) - _LEAST_ELEMENT
    shrunk = np.diff(profile.knot) - np.diff(trial.knot)
    share = np.min(np.where(shrunk > gap, np.maximum(gap, 0.0) / np.maximum(shrunk, 1e-12), 1.0), initial=1.0)
    return replace(trial, knot=profile.knot + share * (trial.knot - profile.knot))


def _between(profile: Profile, j: int) -> Float[np.ndarray, " k"]:
    """Return the condition that the value at knot j lies on the line between its neighbours."""
    before, here, after = profile.knot[j - 1 : j + 2]
    share = (here - before) / (after - before)
    condition = np.zeros(len(profile.knot))
    condition[j - 1 : j + 2] = [1.0 - share, -1.0, share]
    return condition


def _normal(profile: Profile, target: Target) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]]:
    """Return the normal matrix of the start's correction and the values, and its right side."""
    free = np.arange(len(profile.knot))
    matrix = _jacobian(profile, free, target, move=False)
    numbers = _pack(profile, free, False)
    numbers[: len(profile.start)] = 0.0
    return matrix.T @ matrix, matrix.T @ (matrix @ numbers - target.miss(profile))


def _costs(profile: Profile, inverse: Float[np.ndarray, "p p"]) -> Float[np.ndarray, " k"]:
    """Return by how much the sum of squares would grow if each knot were taken out; infinite for both ends.

    Args:
        profile: The profile at its least sum.
        inverse: Inverse of the normal matrix of start and values.
    """
    inner = inverse[len(profile.start) :, len(profile.start) :]
    costs = np.full(len(profile.knot), np.inf)
    for j in range(1, len(profile.knot) - 1):
        condition = _between(profile, j)
        costs[j] = (condition @ profile.value) ** 2 / max(condition @ inner @ condition, 1e-30)
    return costs


def _without(profile: Profile, j: int) -> Profile:
    return replace(profile, knot=np.delete(profile.knot, j), value=np.delete(profile.value, j))


def _thin_linear(profile: Profile, target: Target, allowed: float) -> Profile:
    """Take out knots, the cheapest first and without moving the others, while the mean square stays allowed.

    Curvature is small, so the problem is linear in start and values, and is set up once.
    """
    normal, right = _normal(profile, target)
    spare = (allowed - float(np.mean(target.miss(profile) ** 2))) * len(target.station)
    start, first, spent = profile.start, len(profile.start), 0.0
    while len(profile.knot) > 3:
        inverse = np.linalg.pinv(normal, rcond=1e-14, hermitian=True)
        numbers = inverse @ right
        profile = Profile(profile.knot, numbers[first:], start + numbers[:first])
        costs = _costs(profile, inverse)
        j = int(np.argmin(costs))
        spent += float(costs[j])
        if spent > spare:
            break
        # The value at the knot becomes that between its neighbours.
        fold = np.delete(np.eye(len(normal)), first + j, axis=1)
        share = np.delete(_between(profile, j), j)
        fold[first + j, first:] = share
        normal, right = fold.T @ normal @ fold, fold.T @ right
        profile = _without(profile, j)
    return _adjust(profile, np.arange(len(profile.knot)), target, move=False)


def _thin(profile: Profile, target: Target, allowed: float, tries: int = 8) -> Profile:
    """Take out knots while the others, moved, keep the mean square allowed."""
    while len(profile.knot) > 2:
        inverse = np.linalg.pinv(_normal(profile, target)[0], rcond=1e-14, hermitian=True)
        for j in np.argsort(_costs(profile, inverse))[:tries]:
            if j in (0, len(profile.knot) - 1):
                continue
            trial = _adjust(_without(profile, int(j)), np.arange(len(profile.knot) - 1), target, rounds=25)
            if float(np.mean(target.miss(trial) ** 2)) <= allowed:
                profile = trial
                break
        else:
            return profile
    return profile


def _equalise(profile: Profile, target: Target, allowed: float) -> tuple[Profile, Tie]:
    """Make neighbouring values equal, and small ones zero, the cheapest first, while the mean square stays allowed."""
    tie = np.arange(len(profile.knot))
    refused: set[tuple[int, ...]] = set()
    while True:
        for trial_tie in _next_ties(profile, tie):
            if tuple(trial_tie) in refused:
                continue
            trial = _adjust(_unpack(_pack(profile, trial_tie, True), profile, trial_tie, True), trial_tie, target)
            if float(np.mean(target.miss(trial) ** 2)) <= allowed:
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
    return [_renumber(one) for _, one in sorted(found, key=lambda pair: pair[0])]


def _renumber(tie: Tie) -> Tie:
    kept = np.unique(tie[tie >= 0])
    return np.where(tie < 0, -1, np.searchsorted(kept, tie))


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
