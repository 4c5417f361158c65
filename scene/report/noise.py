"""Noise of surveyed points by what a fit leaves of it, and what it leaves open of each element of an alignment."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from scene.report.profiles import Profile, Target, Tie, jacobian, renumber

_ALIKE = (0.0, 0.7, 1.0, 1.5, 2.0, 3.0, 4.5, 6.5, 10.0)  # m, widths of averages that noise may be
_LAGS = 20  # points over which what a fit leaves is compared with itself


@dataclass(frozen=True)
class Spread:
    """One standard deviation of the numbers of an element, as far as the points tell.

    Attributes:
        length: Of its length, m; an end of the survey is no end of an element and adds nothing.
        first: Of the curvature (1/m) or grade at its beginning.
        last: The same at its end.
    """

    length: float
    first: float
    last: float


def find_spread(profile: Profile, tie: Tie, target: Target) -> tuple[Spread, ...]:
    """Return what the points leave open of each element between two knots.

    The noise is that whose remainder would look like what the elements leave. That number and kinds of the elements
    are right is taken for granted, and so is that the axis does not wander over lengths like theirs.

    Args:
        profile: The profile at its least sum of squares, with no knot inside an element.
        tie: Which values are one number.
        target: The points.
    """
    tie = renumber(tie)
    matrix = jacobian(profile, tie, target, move=True)
    scale = np.maximum(np.linalg.norm(matrix, axis=0), 1e-12)
    # One of the two numbers of the start in plan is not seen, since it moves across alone.
    inverse = np.linalg.pinv(matrix / scale, rcond=1e-10)
    covariance = inverse @ likely_noise(target.miss(profile), target.station, matrix / scale @ inverse) @ inverse.T
    covariance = covariance / scale / scale[:, None]
    first, count = len(profile.start), int(tie.max()) + 1
    inner = np.arange(len(profile.knot) - 2)
    knot, value = np.zeros((2, len(profile.knot), len(scale)))
    knot[1 + inner, first + count + inner] = 1.0  # both ends are the survey's
    value[tie >= 0, first + tie[tie >= 0]] = 1.0
    length, bend = (np.sqrt(np.sum(part @ covariance * part, axis=1)) for part in (np.diff(knot, axis=0), value))
    return tuple(Spread(*(float(one) for one in row)) for row in zip(length, bend[:-1], bend[1:], strict=True))


def likely_noise(
    residual: Float[np.ndarray, " n"], station: Float[np.ndarray, " n"], hat: Float[np.ndarray, "n n"]
) -> Float[np.ndarray, "n n"]:
    """Return the covariance of noise by what a fit leaves of it, m²: a Gaussian average over some metres, or none.

    A fit takes most of what varies slowly, so that noise errs alike further than its remainder does.

    Args:
        residual: Distances of the points from the fit, m.
        station: Their stations, m.
        hat: Change of the fit for a change of the points.
    """
    n = len(residual)
    left = np.eye(n) - hat
    lags = range(min(_LAGS, n // 4))
    seen = np.array([float(residual[k:] @ residual[: n - k]) for k in lags])
    best, least = np.eye(n), np.inf
    for metres in _ALIKE:
        noise = np.exp(-((np.subtract.outer(station, station) / (2.0 * metres)) ** 2)) if metres else np.eye(n)
        remainder = left @ noise @ left.T
        expected = np.array([float(np.trace(remainder, k)) for k in lags])
        size = float(seen[0] / max(expected[0], 1e-30))
        if (away := float(np.sum((seen - size * expected) ** 2))) < least:
            best, least = size * noise, away
    return best


def correlated_noise(residual: Float[np.ndarray, " n"], numbers: int) -> tuple[float, float]:
    """Return the noise of points and over how many of them it errs alike, by what a fit leaves.

    Args:
        residual: Distances of the points from the fit, m.
        numbers: Numbers that were fitted.

    Returns:
        Standard deviation, m, by the median, which a few misfits do not change; sum of the correlations with all
        points, up to the first that is negative: 1 where each point errs on its own.
    """
    n = len(residual)
    sigma = 1.4826 * float(np.median(np.abs(residual))) * np.sqrt(n / max(1, n - numbers))
    power = float(np.mean(residual**2))
    shared = [float(residual[k:] @ residual[: n - k]) / n for k in range(1, n // 4)]
    until = next((k for k, value in enumerate(shared) if value <= 0.0), len(shared))
    return sigma, 1.0 + 2.0 * sum(shared[:until]) / max(power, 1e-30)
