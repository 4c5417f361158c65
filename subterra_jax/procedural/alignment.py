"""Centrelines of straights, arcs and clothoids: curvature as a broken line over station, integrated in float64."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from subterra_jax.errors import SubterraError
from subterra_jax.procedural.config import ProceduralConfig

# Parts of a tunnel further apart along it than _ALONG may not come nearer to one another than _APART, m: a LiDAR with a
# reach of 30 m never sees into another part, and no window of walls need hold two.
_ALONG, _APART, _SAMPLE = 60.0, 40.0, 2.0
_TRIES = 200


@dataclasses.dataclass(frozen=True)
class Alignment:
    """A centreline in plan that starts at the origin along x.

    Attributes:
        knot: Stations at which the curvature's course breaks, from 0, m, `(k,)`.
        curvature: Curvature there, to the left positive, 1/m, `(k,)`; linear between, which makes clothoids.
        length: m.
        step: Of the nodes from which positions are integrated, m.
    """

    knot: Float[np.ndarray, " k"]
    curvature: Float[np.ndarray, " k"]
    length: float
    step: float

    @property
    def station(self) -> Float[np.ndarray, " n"]:
        """The uniform chainage grid from 0 to the length, m."""
        return np.linspace(0.0, self.length, max(2, round(self.length / self.step) + 1))

    def heading(self, station: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Direction of the tangent, rad, not wrapped: the exact integral of the curvature."""
        width = np.diff(self.knot)
        slope = np.diff(self.curvature) / width
        turned = np.concatenate([[0.0], np.cumsum(0.5 * (self.curvature[1:] + self.curvature[:-1]) * width)])
        i = np.clip(np.searchsorted(self.knot, station, side="right") - 1, 0, len(width) - 1)
        beyond = station - self.knot[i]
        return turned[i] + self.curvature[i] * beyond + 0.5 * slope[i] * beyond * beyond

    def tangent(self, station: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m 2"]:
        """Unit tangent."""
        heading = self.heading(station)
        return np.stack([np.cos(heading), np.sin(heading)], axis=-1)

    def position(self, station: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m 2"]:
        """Position, m: Simpson's rule from node to node, exact to far less than a micrometre for steps below 1 m."""
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
        """Points `lateral` metres to the left of the centreline, m."""
        tangent = self.tangent(station)
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
        return self.position(station) + lateral[:, None] * normal


def draw_alignment(rng: np.random.Generator, length: float, config: ProceduralConfig) -> Alignment:
    """A centreline of bends and straights that stays clear of itself.

    Args:
        rng: Source of randomness.
        length: m.
        config: The family.

    Raises:
        SubterraError: The family's bends are such that hardly any centreline stays clear of itself.
    """
    for _ in range(_TRIES):
        knot, curvature = _bends(rng, length, config)
        alignment = Alignment(knot, curvature, length, config.grid_step)
        if _clear(alignment):
            return alignment
    raise SubterraError(
        f"none of {_TRIES} centrelines of {length:.0f} m with radii of {config.radius} m and turns of up to "
        f"{config.turn} rad stays {_APART:.0f} m clear of itself"
    )


def _bends(
    rng: np.random.Generator, length: float, config: ProceduralConfig
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Knots of the curvature until beyond the length."""
    knot, curvature = [0.0, rng.uniform(*config.straight)], [0.0, 0.0]
    side = rng.choice([-1.0, 1.0])
    while knot[-1] < length:
        bend = side / np.exp(rng.uniform(*np.log(config.radius)))
        arc = min(rng.uniform(*config.arc), config.turn / abs(bend))
        knot += [knot[-1] + rng.uniform(*config.transition)]
        knot += [knot[-1] + arc]
        curvature += [bend, bend]
        if rng.random() < config.reverse_share:
            side = -side
            continue
        knot += [knot[-1] + rng.uniform(*config.transition)]
        knot += [knot[-1] + rng.uniform(*config.straight)]
        curvature += [0.0, 0.0]
        side = rng.choice([-1.0, 1.0])
    return np.array(knot), np.array(curvature)


def _clear(alignment: Alignment) -> bool:
    """Whether no two distant parts come near one another."""
    station = np.arange(0.0, alignment.length, _SAMPLE)
    x, y = alignment.position(station).T
    apart = int(_ALONG / _SAMPLE)
    first, second = np.triu_indices(len(station), k=apart)
    near = (x[first] - x[second]) ** 2 + (y[first] - y[second]) ** 2 < _APART**2
    return not near.any()
