"""Centrelines, random lines along them, and walls beside them, in float64."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from subterra_jax.host.errors import SubterraError

Range = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class LineRanges:
    """Ranges that centrelines are drawn from: least and largest value; draws are uniform unless said."""

    radius: Range  # radius of a bend, m, drawn uniformly in its logarithm
    straight: Range  # length between two bends, m
    arc: Range  # length of constant curvature, m
    transition: Range  # length of each clothoid, over which the curvature changes evenly, m
    turn: float  # largest turn of one bend, without its clothoids, rad
    reverse_fraction: float = 0.3  # fraction of bends followed by the opposite bend without a straight
    grid_step: float = 0.25  # step of the station grid, m


# Parts of a tunnel more than _ALONG apart along it stay more than _APART from one another, m: a LiDAR with a reach of
# 30 m never sees into another part, and no window of walls need hold two.
_ALONG, _APART, _SAMPLE = 60.0, 40.0, 2.0
_TRIES = 200


@dataclasses.dataclass(frozen=True)
class Alignment:
    """A centreline in plan that starts at the origin along x."""

    knot: Float[np.ndarray, " k"]  # stations at which the curvature's slope changes, from 0, m, `(k,)`
    # curvature there, to the left positive, 1/m, `(k,)`; linear between, which makes clothoids
    curvature: Float[np.ndarray, " k"]
    length: float  # length of the centreline, m
    step: float  # distance of the nodes for integrating positions, m

    @property
    def station(self) -> Float[np.ndarray, " n"]:
        """Uniform stations from 0 to the length, m."""
        return np.linspace(0.0, self.length, max(2, round(self.length / self.step) + 1))

    def heading(self, station: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Return the direction of the tangent, rad, not wrapped: the exact integral of the curvature."""
        width = np.diff(self.knot)
        slope = np.diff(self.curvature) / width
        turned = np.concatenate([[0.0], np.cumsum(0.5 * (self.curvature[1:] + self.curvature[:-1]) * width)])
        i = np.clip(np.searchsorted(self.knot, station, side="right") - 1, 0, len(width) - 1)
        beyond = station - self.knot[i]
        return turned[i] + self.curvature[i] * beyond + 0.5 * slope[i] * beyond * beyond

    def tangent(self, station: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m 2"]:
        heading = self.heading(station)
        return np.stack([np.cos(heading), np.sin(heading)], axis=-1)

    def position(self, station: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m 2"]:
        """Return the position, m, by Simpson's rule: exact to far less than a micrometre for steps below 1 m."""
        node = self.station
        stretches = self._chord(node[:-1], node[1:])
        at_node = np.concatenate([np.zeros((1, 2)), np.cumsum(stretches, axis=0)])
        i = np.clip(np.floor(station / node[1]).astype(int), 0, len(node) - 1)
        return at_node[i] + self._chord(node[i], station)

    def _chord(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        middle = 0.5 * (start + end)
        mean = (self.tangent(start) + 4.0 * self.tangent(middle) + self.tangent(end)) / 6.0
        return (end - start)[:, None] * mean

    def offset(self, station: Float[np.ndarray, " m"], lateral: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m 2"]:
        """Return points `lateral` metres to the left of the centreline, m."""
        tangent = self.tangent(station)
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
        return self.position(station) + lateral[:, None] * normal


def draw_alignment(rng: np.random.Generator, length: float, ranges: LineRanges) -> Alignment:
    """Draw a centreline of bends and straights that stays clear of itself.

    Args:
        length: Length, m.
        ranges: Ranges of its bends and straights.

    Raises:
        SubterraError: The bends are such that hardly any centreline stays clear of itself.
    """
    for _ in range(_TRIES):
        knot, curvature = _bends(rng, length, ranges)
        alignment = Alignment(knot, curvature, length, ranges.grid_step)
        if _clear(alignment):
            return alignment
    raise SubterraError(
        f"none of {_TRIES} centrelines of {length:.0f} m with radii of {ranges.radius} m and turns of up to "
        f"{ranges.turn} rad stays {_APART:.0f} m clear of itself"
    )


def _bends(
    rng: np.random.Generator, length: float, ranges: LineRanges
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Draw knots of the curvature until beyond the length."""
    knot, curvature = [0.0, rng.uniform(*ranges.straight)], [0.0, 0.0]
    side = rng.choice([-1.0, 1.0])
    while knot[-1] < length:
        bend = side / np.exp(rng.uniform(*np.log(ranges.radius)))
        arc = min(rng.uniform(*ranges.arc), ranges.turn / abs(bend))
        knot += [knot[-1] + rng.uniform(*ranges.transition)]
        knot += [knot[-1] + arc]
        curvature += [bend, bend]
        if rng.random() < ranges.reverse_fraction:
            side = -side
            continue
        knot += [knot[-1] + rng.uniform(*ranges.transition)]
        knot += [knot[-1] + rng.uniform(*ranges.straight)]
        curvature += [0.0, 0.0]
        side = rng.choice([-1.0, 1.0])
    return np.array(knot), np.array(curvature)


def _clear(alignment: Alignment) -> bool:
    station = np.arange(0.0, alignment.length, _SAMPLE)
    x, y = alignment.position(station).T
    apart = int(_ALONG / _SAMPLE)
    first, second = np.triu_indices(len(station), k=apart)
    near = (x[first] - x[second]) ** 2 + (y[first] - y[second]) ** 2 < _APART**2
    return not near.any()


_FINE = 8  # samples of a random line in one correlation length


def wander(
    rng: np.random.Generator, station: Float[np.ndarray, " n"], sd: float, correlation: float
) -> Float[np.ndarray, " n"]:
    """Draw a smooth random line along the tunnel: Gaussian, with covariance `sd² exp(−d² / correlation²)`.

    Args:
        station: Stations of the result, m, growing.
        sd: Standard deviation, in the unit of the result.
        correlation: Correlation length, m.
    """
    step = correlation / _FINE
    reach = 3 * _FINE
    at = station[0] + step * np.arange(-reach, int((station[-1] - station[0]) / step) + reach + 3)
    # Covariances add their squares: a kernel of half the square of the correlation length.
    kernel = np.exp(-2.0 * (np.arange(-reach, reach + 1) / _FINE) ** 2)
    noise = np.convolve(rng.standard_normal(len(at) + 2 * reach), kernel / np.linalg.norm(kernel), mode="valid")
    return sd * np.interp(station, at, noise)
