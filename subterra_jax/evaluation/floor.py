"""The floor of a task: the most that anybody can expect who never localises by the walls.

Such an agent has commands, odometry, the flag and what it is given, and knows the sizes of every error and, under
faults, the episode's severity; no start and no goal lies in view of a mouth. float64 on the host, sharing no code with
the simulator or the agents: who stands above it has looked at the walls, or has been reported.
"""

import math

import numpy as np
from jaxtyping import Float

from subterra_jax.state import EnvParams

STRETCH = 1.0  # m over which a wandering error is taken to be constant
FLAG_SIGMA = 0.06  # m; the flag is raised within one step of 0.2 m
_GOALS = 60
_DRAWS = 4000
_PATCH = 10.0  # m of rail that are wet or dry as a whole


def floor(params: EnvParams, index: int = 0) -> float:
    """Compute the largest expected success without a look at the walls, 0 to 1, to the first order in the errors.

    Args:
        params: A task with a goal.
        index: Number of the tunnel in a stack.
    """
    length = float(np.broadcast_to(np.asarray(params.tunnel.length), params.tunnel.count)[index])
    tolerance, room = float(params.goal.tolerance), length - 2.0 * float(params.goal.margin)
    if params.goal_kind == "report":
        # Anywhere in the room, and either way.
        return 0.5 * min(1.0, 2.0 * tolerance / max(room, 2.0 * tolerance))
    high = min(float(params.goal.high), room)
    low = min(float(params.goal.low), high)
    distance = low + (high - low) * (np.arange(_GOALS) + 0.5) / _GOALS
    start = float(params.start.station_sigma) ** 2
    if params.goal_kind == "return":
        return within(tolerance, np.sqrt(way_back_variance(distance, params)))
    variance = way_out_variance(distance, params)
    if "faults" in params.parts:
        return _on_wet_rail(distance, np.sqrt(variance + start), tolerance, params)
    return within(tolerance, np.sqrt(variance + start))


def within(tolerance: float, sigma: Float[np.ndarray, " n"]) -> float:
    """Return the mean probability that a normal error lies within a tolerance."""
    return float(np.mean([math.erf(tolerance / (math.sqrt(2.0) * max(s, 1e-9))) for s in sigma]))


def is_above(success: float, bound: float, n: int, n_bound: int = 0) -> bool:
    """Tell whether a fraction of `n` episodes is four standard errors above a bound: a table has some hundred of them.

    The bound is exact, or itself a fraction of `n_bound` episodes.
    """
    variance = max(bound * (1.0 - bound), 0.25 / n) * (1.0 / n + (1.0 / n_bound if n_bound else 0.0))
    return success - bound > 4.0 * math.sqrt(variance)


def way_out_variance(distance: Float[np.ndarray, " n"], params: EnvParams) -> Float[np.ndarray, " n"]:
    """Compute the variance of the distance driven after commands and readings of the way out, m²."""
    errors = _Errors(params)
    found = [0.0, *(errors.drive(1.0) for _ in range(math.ceil(distance.max() / STRETCH)))]
    return np.interp(distance, STRETCH * np.arange(len(found)), found)


def way_back_variance(distance: Float[np.ndarray, " n"], params: EnvParams) -> Float[np.ndarray, " n"]:
    """Compute the variance of the station at the end of a way out to the flag and back, m².

    With a known start the flag tells the errors of the way out, which are in part those of the way back.
    """
    found = []
    for goal in distance:
        errors = _Errors(params, float(params.start.station_sigma) ** 2)
        n = max(1, round(goal / STRETCH))
        for _ in range(n):
            errors.drive(1.0)
        errors.learn(np.eye(6)[0], FLAG_SIGMA**2)
        for _ in range(n):
            errors.drive(-1.0)
        found.append(errors.covariance[0, 0])
    return np.array(found)


class _Errors:
    """Covariance of a Kalman filter, which needs no data, over stretches of `STRETCH`.

    The state is the station (m), the lasting and the wandering slip, the lasting and the wandering scale error of the
    odometer, and what is added to that while facing falling stations.

    Args:
        start: Variance of the station of the start, m².
    """

    def __init__(self, params: EnvParams, start: float = 0.0):
        slip, odometry = params.slip, params.odometry
        lasting = (0.0, slip.gain_sigma, 0.0, odometry.distance_bias_sigma, 0.0, odometry.backward_bias_sigma or 0.0)
        wandering = (None, None, slip.wander, None, odometry.wander, None)
        self._stationary = np.array([0.0 if w is None else float(w.sigma) ** 2 for w in wandering])
        self._keep = np.array([1.0 if w is None else math.exp(-STRETCH / float(w.length)) for w in wandering])
        self.covariance = np.diag(np.square(np.asarray(lasting, float)) + self._stationary)
        self.covariance[0, 0] += start
        full_step = float(np.max(params.vehicle.speed_max * params.vehicle.period))
        # The readings' noise of a stretch, over its length: a variance of the scale.
        self._noise = max(float(params.odometry.distance_sigma) ** 2 / (full_step * STRETCH), 1e-15)

    def drive(self, direction: float) -> float:
        """Drive a stretch by growing (1) or falling stations (-1); return the variance of the station after it, m²."""
        self.learn(np.array([0.0, 1.0, 1.0, 1.0, 1.0, float(direction < 0.0)]), self._noise)
        moved = np.eye(6)
        moved[0, 1:3] = direction * STRETCH
        covariance = moved @ self.covariance @ moved.T
        self.covariance = covariance * np.outer(self._keep, self._keep) + np.diag(
            (1.0 - self._keep**2) * self._stationary
        )
        return float(self.covariance[0, 0])

    def learn(self, row: Float[np.ndarray, "6"], noise: float) -> None:
        spread = self.covariance @ row
        self.covariance = self.covariance - np.outer(spread, spread) / (row @ spread + noise)


def _on_wet_rail(
    distance: Float[np.ndarray, " n"], sigma: Float[np.ndarray, " n"], tolerance: float, params: EnvParams
) -> float:
    """Success of the best distance to command, over severities, wet fractions, losses and places of wet patches.

    Nothing but the walls tells wet rail, so the best is one distance for each goal and severity.
    """
    generator = np.random.default_rng(0)
    faults = params.faults
    spread = float(getattr(faults, "spread", 0.0))
    drawn = lambda size: float(size) * (1.0 + spread * generator.uniform(-1.0, 1.0, _DRAWS))  # noqa: E731
    total = []
    for severity in range(int(faults.severity_low), int(faults.severity_high) + 1):
        fraction, loss = drawn(faults.wet_fraction) * severity / 4.0, np.minimum(drawn(faults.wet_loss), 0.95)
        at_end = np.where(generator.random(_DRAWS) < fraction, 1.0 - loss, 1.0)
        for goal, error in zip(distance, sigma, strict=True):
            patches = generator.binomial(max(1, round(goal / _PATCH)), np.clip(fraction, 0.0, 1.0))
            needed = goal + _PATCH * patches * loss / (1.0 - loss) + error * generator.standard_normal(_DRAWS)
            total.append(_best_fraction(needed, tolerance / at_end))
    return float(np.mean(total))


def _best_fraction(needed: Float[np.ndarray, " n"], reach: Float[np.ndarray, " n"]) -> float:
    """Return the largest fraction of intervals `needed ± reach` that hold one and the same point."""
    ends = np.concatenate([needed - reach, needed + reach])
    change = np.concatenate([np.ones(len(needed)), -np.ones(len(needed))])
    return float(np.max(np.cumsum(change[np.argsort(ends, kind="stable")])) / len(needed))
