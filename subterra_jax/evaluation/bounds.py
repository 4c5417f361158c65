"""Theoretical success of a stop without a look at the walls, from the drift that the task states.

float64 on the host, sharing no code with the simulator or the agents, so that an agent above its bound is a leak.
"""

import math

import numpy as np
from jaxtyping import Float

from subterra_jax.parts.wander import WanderParams
from subterra_jax.state import EnvParams

_STRETCH = 0.5  # m over which a wandering error is taken to be constant
_GOALS = 200


def stop_bounds(params: EnvParams) -> dict[str, float]:
    """Expected success of a stop at the goal, 0 to 1, from commands, from odometry, and from the best of both.

    Args:
        params: A task with slip and a goal, whose distance is drawn uniformly between its bounds.

    Returns:
        `command`, `odometry` and `fused`, to the first order in the errors. `fused` is the most that anybody can have
        who knows the task's priors and sees no walls.
    """
    room = float(np.min(params.tunnel.length)) - 2.0 * float(params.goal.margin)
    high = min(float(params.goal.high), room)
    low = min(float(params.goal.low), high)
    distance = low + (high - low) * (np.arange(_GOALS) + 0.5) / _GOALS
    slip, odometry, metre = params.slip, params.odometry, _noise_of_a_metre(params)
    variances = {
        "command": (slip.gain_sigma * distance) ** 2 + _wander_variance(distance, slip.wander),
        "odometry": (odometry.distance_bias_sigma * distance) ** 2 + _wander_variance(distance, odometry.wander),
        "fused": _fused_variance(distance, params),
    }
    variances["odometry"] = variances["odometry"] + metre * distance
    tolerance, start = float(params.goal.tolerance), float(params.start.station_sigma) ** 2
    return {name: _within(tolerance, np.sqrt(variance + start)) for name, variance in variances.items()}


def _within(tolerance: float, sigma: Float[np.ndarray, " n"]) -> float:
    """Mean probability of an error within a tolerance."""
    return float(np.mean([math.erf(tolerance / (math.sqrt(2.0) * max(s, 1e-9))) for s in sigma]))


def _noise_of_a_metre(params: EnvParams) -> float:
    """Variance that the odometer's noise of each step adds in a metre at full speed, m² / m."""
    step = float(np.max(params.vehicle.speed_max * params.vehicle.period))
    return float(params.odometry.distance_sigma) ** 2 / step


def _wander_variance(distance: Float[np.ndarray, " n"], wander: WanderParams | None) -> Float[np.ndarray, " n"]:
    """Variance of the integral of a wandering error, m²."""
    if wander is None:
        return np.zeros_like(distance)
    sigma, length = float(wander.sigma), float(wander.length)
    return 2.0 * sigma**2 * length * (distance + length * np.expm1(-distance / length))


def _fused_variance(distance: Float[np.ndarray, " n"], params: EnvParams) -> Float[np.ndarray, " n"]:
    """Variance of the true distance given commands and readings, m²: a Kalman filter's, which needs no data."""
    n = math.ceil(distance.max() / _STRETCH)
    variance = _station_variance(np.zeros((n, 1)), params, 0.0)
    return np.interp(distance, _STRETCH * np.arange(n + 1), variance)


def filter_variance(
    station: Float[np.ndarray, " n"],
    information: Float[np.ndarray, " n"] | Float[np.ndarray, "n blur"],
    params: EnvParams,
    blurs: tuple[float, ...] = (),
) -> Float[np.ndarray, " n"]:
    """Compute the variance of the station that a perfect filter keeps on the way through a tunnel at full speed, m².

    It has commands, odometry and the information of each scan; to the first order in the errors.

    Args:
        station: Stations, m, growing.
        information: Information of one scan about the station there, 1/m²; with `blurs` a column for each of them.
        params: A task with slip; its start and its errors of commands and odometry.
        blurs: Standard deviations of the station for which the columns hold, m, growing. Each scan then answers a
            filter as uncertain as this one is at that place, within their range.

    Returns:
        Variances; behind the start, that of the start.

    Source: Tichavský et al. 1998, the recursion of the posterior Cramér–Rao bound, here of a linear system.
    """
    begin, start = float(params.start.station), float(params.start.station_sigma) ** 2
    n = max(1, math.ceil((station[-1] - begin) / _STRETCH))
    at = begin + _STRETCH * (np.arange(n) + 1.0)
    scans = _STRETCH / float(np.max(params.vehicle.speed_max * params.vehicle.period))
    columns = information.reshape(len(station), -1).T
    told = scans * np.stack([np.interp(at, station, column) for column in columns], axis=-1)
    variance = _station_variance(told, params, start, blurs)
    return np.interp(station, begin + _STRETCH * np.arange(n + 1), variance)


def _station_variance(
    information: Float[np.ndarray, "n blur"], params: EnvParams, start: float, blurs: tuple[float, ...] = ()
) -> Float[np.ndarray, " n+1"]:
    """Variance of the station after each stretch, m², given what is learnt about it at the end of each, 1/m².

    Of several columns, each for a blur, the one counts that is as blurred as the station then is.

    The state is the station, the constant and the wandering slip, the constant and the wandering scale error.
    """
    slip, odometry = params.slip, params.odometry
    wanders = (None, None, slip.wander, None, odometry.wander)
    sigma = np.array([0.0, slip.gain_sigma, 0.0, odometry.distance_bias_sigma, 0.0])
    stationary = np.array([0.0 if w is None else float(w.sigma) ** 2 for w in wanders])
    keep = np.array([1.0 if w is None else math.exp(-_STRETCH / float(w.length)) for w in wanders])
    noise = max(_noise_of_a_metre(params) / _STRETCH, 1e-15)
    moved, read, here = np.eye(5), np.array([0.0, 1.0, 1.0, 1.0, 1.0]), np.eye(5)[0]
    moved[0, 1:3] = _STRETCH
    covariance, found = np.diag(sigma**2 + stationary + start * here), [start]
    for row in information:
        covariance = _learn(covariance, read, noise)
        # The error of the whole stretch becomes known as the reading of that stretch is.
        covariance = moved @ covariance @ moved.T
        covariance = covariance * np.outer(keep, keep) + np.diag((1.0 - keep**2) * stationary)
        told = row[0] if not blurs else np.interp(0.5 * np.log(max(covariance[0, 0], 1e-12)), np.log(blurs), row)
        if told > 0.0:
            covariance = _learn(covariance, here, 1.0 / told)
        found.append(covariance[0, 0])
    return np.array(found)


def _learn(covariance: Float[np.ndarray, "5 5"], row: Float[np.ndarray, "5"], noise: float) -> Float[np.ndarray, "5 5"]:
    """Covariance after a measurement `row · state` with a variance of noise."""
    spread = covariance @ row
    return covariance - np.outer(spread, spread) / (row @ spread + noise)
