"""A quantity along an axis that is linear between knots, and its least squares against the axis's points.

Curvature in plan and grade in profile are one problem: where the quantity is constant there is an arc or a line (a
straight grade), where it slopes a clothoid (a parabola). Start, values and places of the knots are all unknowns.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import interp1d

_STEP = 1.0  # m between the nodes of the integration
LEAST_ELEMENT = 4.0  # m
_ROUNDS = 30  # of Gauss-Newton

Tie = Int[np.ndarray, " k"]  # number of the value at each knot; knots that share one are equal, -1 is zero


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
class PlanTarget:
    """Points of an axis in plan, m, at their stations; its start may move along `across` alone.

    Moved along the axis, together with all knots, it would change nothing that is measured.
    """

    points: Float[np.ndarray, "n 2"]
    station: Float[np.ndarray, " n"]
    across: Float[np.ndarray, "2"]

    def miss(self, profile: Profile) -> Float[np.ndarray, " n"]:
        """See `Target`."""
        at, heading = profile.plan(self.station)
        across = self.points - at
        return across[:, 1] * np.cos(heading) - across[:, 0] * np.sin(heading)

    def start_columns(self, profile: Profile) -> Float[np.ndarray, "n 3"]:
        """See `Target`."""
        at, heading = profile.plan(self.station)
        moved = at - profile.start[:2]
        turned = moved[:, 0] * np.cos(heading) + moved[:, 1] * np.sin(heading)
        aside = self.across[1] * np.cos(heading) - self.across[0] * np.sin(heading)
        return np.stack([self.across[0] * aside, self.across[1] * aside, turned], axis=1)

    def columns(
        self, profile: Profile, node: Float[np.ndarray, " m"], turned: Float[np.ndarray, "m p"]
    ) -> Float[np.ndarray, "n p"]:
        """See `Target`."""
        bearing = profile.start[2] + profile.integral(node)
        aside = [cumulate(part[:, None] * turned, node) for part in (-np.sin(bearing), np.cos(bearing))]
        x, y = (interp1d(node, part, axis=0)(self.station) for part in aside)
        heading = (profile.start[2] + profile.integral(self.station))[:, None]
        return y * np.cos(heading) - x * np.sin(heading)

    def noise(self) -> float:
        """Return the noise of the points, m: what of their fourth differences no alignment explains."""
        return _noise(self._aside())

    def _aside(self) -> Float[np.ndarray, " m"]:
        """Return fourth differences across the axis, m."""
        tangent = np.gradient(self.points, axis=0)[2:-2]
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1) / np.linalg.norm(tangent, axis=1, keepdims=True)
        return np.sum(np.diff(self.points, 4, axis=0) * normal, axis=1)


@dataclass(frozen=True)
class HeightTarget:
    """Heights of an axis, m, at their stations."""

    height: Float[np.ndarray, " n"]
    station: Float[np.ndarray, " n"]

    def miss(self, profile: Profile) -> Float[np.ndarray, " n"]:
        """See `Target`."""
        return self.height - profile.height(self.station)

    def start_columns(self, profile: Profile) -> Float[np.ndarray, "n 1"]:
        """See `Target`."""
        del profile
        return np.ones((len(self.station), 1))

    def columns(
        self, profile: Profile, node: Float[np.ndarray, " m"], turned: Float[np.ndarray, "m p"]
    ) -> Float[np.ndarray, "n p"]:
        """See `Target`."""
        del profile
        return interp1d(node, turned, axis=0)(self.station)

    def noise(self) -> float:
        """Return the noise of the points, m: what of their fourth differences no alignment explains."""
        return _noise(np.diff(self.height, 4))


def _noise(fourth: Float[np.ndarray, " m"]) -> float:
    """Return the standard deviation of noise by its fourth differences; few knots do not change the median."""
    return float(1.4826 * np.median(np.abs(fourth - np.median(fourth))) / np.sqrt(70.0))


def pack(profile: Profile, tie: Tie, move: bool) -> Float[np.ndarray, " p"]:
    """Return start, the values of the ties and, with `move`, the inner knots as one vector."""
    groups = [profile.value[tie == group].mean() for group in range(tie.max() + 1)]
    return np.concatenate([profile.start, groups, profile.knot[1:-1] if move else []])


def unpack(numbers: Float[np.ndarray, " p"], profile: Profile, tie: Tie, move: bool) -> Profile:
    """Return the profile of such a vector; its last knots are those of `profile`."""
    first, count = len(profile.start), tie.max() + 1
    value = np.where(tie < 0, 0.0, numbers[first + np.maximum(tie, 0)]) if count else np.zeros(len(tie))
    knot = profile.knot
    if move:
        inner = numbers[first + count :]
        knot = np.concatenate([knot[:1], inner, knot[-1:]])
    return Profile(knot, value, numbers[:first])


def jacobian(profile: Profile, tie: Tie, target: Target, move: bool) -> Float[np.ndarray, "n p"]:
    """Return the derivatives of the misses: start, values of the ties and, with `move`, inner knots."""
    node = np.linspace(profile.knot[0], profile.knot[-1], round((profile.knot[-1] - profile.knot[0]) / _STEP) + 2)
    before, after = _hats(profile.knot, node)
    slope = np.diff(profile.value) / np.diff(profile.knot)
    parts = [(before + after) @ (tie[:, None] == np.arange(tie.max() + 1))]
    if move:  # a knot that moves on lowers a rising line on both of its sides
        parts.append(-(before[:, 1:-1] * slope[:-1] + after[:, 1:-1] * slope[1:]))
    turned = cumulate(np.hstack(parts), node)
    return -np.hstack([target.start_columns(profile), target.columns(profile, node, turned)])


def _hats(knot: np.ndarray, node: np.ndarray) -> tuple[Float[np.ndarray, "m k"], Float[np.ndarray, "m k"]]:
    """Return the rising and the falling half of each knot's hat at the nodes."""
    i = np.clip(np.searchsorted(knot, node, side="right") - 1, 0, len(knot) - 2)
    share = (node - knot[i]) / (knot[i + 1] - knot[i])
    rising, falling = np.zeros((2, len(node), len(knot)))
    row = np.arange(len(node))
    rising[row, i + 1], falling[row, i] = share, 1.0 - share
    return rising, falling


def cumulate(values: Float[np.ndarray, "m p"], node: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m p"]:
    """Return the integral from the first node."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(node)[:, None]
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])


def adjust(profile: Profile, tie: Tie, target: Target, *, move: bool = True, rounds: int = _ROUNDS) -> Profile:
    """Fit start, values and, with `move`, the places of the knots, by damped Gauss-Newton steps."""
    damping, cost = 1e-8, float(np.sum(target.miss(profile) ** 2))
    for _ in range(rounds):
        matrix = jacobian(profile, tie, target, move)
        scale = np.maximum(np.linalg.norm(matrix, axis=0), 1e-12)
        normal, right = (matrix / scale).T @ (matrix / scale), -(matrix / scale).T @ target.miss(profile)
        for _ in range(6):
            step = np.linalg.solve(normal + damping * np.eye(len(scale)), right) / scale
            trial = stepped(profile, tie, step, move)
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


def stepped(profile: Profile, tie: Tie, step: Float[np.ndarray, " p"], move: bool) -> Profile:
    """Return the profile after a step; knots stay so far apart that each element keeps its least length."""
    numbers = pack(profile, tie, move) + step
    trial = unpack(numbers, profile, tie, move)
    knot = trial.knot.copy()
    for j in range(1, len(knot) - 1):
        knot[j] = max(knot[j], knot[j - 1] + LEAST_ELEMENT)
    for j in range(len(knot) - 2, 0, -1):
        knot[j] = min(knot[j], knot[j + 1] - LEAST_ELEMENT)
    return replace(trial, knot=knot if knot[1] > knot[0] else profile.knot)


def on_neighbours(profile: Profile, j: int) -> Float[np.ndarray, " k"]:
    """Return the condition that the value at knot j lies on the line between its neighbours."""
    before, here, after = profile.knot[j - 1 : j + 2]
    share = (here - before) / (after - before)
    condition = np.zeros(len(profile.knot))
    condition[j - 1 : j + 2] = [1.0 - share, -1.0, share]
    return condition


def normal_equations(profile: Profile, target: Target) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]]:
    """Return the normal matrix of the start's correction and the values, and its right side."""
    free = np.arange(len(profile.knot))
    matrix = jacobian(profile, free, target, move=False)
    numbers = pack(profile, free, False)
    numbers[: len(profile.start)] = 0.0
    return matrix.T @ matrix, matrix.T @ (matrix @ numbers - target.miss(profile))


def knot_costs(profile: Profile, inverse: Float[np.ndarray, "p p"]) -> Float[np.ndarray, " k"]:
    """Return by how much the sum of squares would grow if each knot were taken out; infinite for both ends.

    Args:
        profile: The profile at its least sum.
        inverse: Inverse of the normal matrix of start and values.
    """
    inner = inverse[len(profile.start) :, len(profile.start) :]
    costs = np.full(len(profile.knot), np.inf)
    for j in range(1, len(profile.knot) - 1):
        condition = on_neighbours(profile, j)
        costs[j] = (condition @ profile.value) ** 2 / max(condition @ inner @ condition, 1e-30)
    return costs


def renumber(tie: Tie) -> Tie:
    """Return a tie whose numbers run from 0 on without a gap."""
    kept = np.unique(tie[tie >= 0])
    return np.where(tie < 0, -1, np.searchsorted(kept, tie))
