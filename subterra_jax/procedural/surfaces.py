"""Relief of a drawn lining, layer by layer, on any columns of a grid of stations and angles."""

from __future__ import annotations

import dataclasses
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from subterra_jax.procedural.kinds import Kind, PatchRanges, RingRanges, StretchRanges

_TERMS = 96  # cosines of a random surface
_CHUNK = 256  # stations that share one factor of the cosines
_DIGITS = 9  # of a height in metres: sums in another order, as another BLAS has it, come out the same


@dataclasses.dataclass(frozen=True)
class Grid:
    """Grid on which a wall is known."""

    station: Float[np.ndarray, " n"]  # uniform stations from 0, m, `(n,)`
    angle: Float[np.ndarray, " m"]  # angles about the axis, from the left towards the crown, rad, `(m,)`
    # angles about the middle of the lining of the wall at those angles, rad, `(m,)`; another than the axis where the
    # invert of a circle is filled, or a walkway moves the robot aside
    bearing: Float[np.ndarray, " m"]
    # way around the section from the floor's middle to each angle, m, `(m,)`; the seam is in the floor
    girth: Float[np.ndarray, " m"]


@dataclasses.dataclass(frozen=True)
class Waves:
    """Gaussian random surface with the covariance `sd² exp(−d² / length²)`, as a sum of cosines.

    Source: Rahimi and Recht 2007, random Fourier features of the squared-exponential kernel.
    """

    frequency: Float[np.ndarray, "k 2"]  # angular frequencies along and around, rad/m, `(k, 2)`
    phase: Float[np.ndarray, " k"]  # phases, rad, `(k,)`
    amplitude: float  # amplitude of each cosine, m

    @classmethod
    def draw(cls, rng: np.random.Generator, sd: float, length: float) -> Waves:
        """Draw a surface of a standard deviation and a correlation length, m."""
        frequency = rng.normal(0.0, np.sqrt(2.0) / length, (_TERMS, 2))
        return cls(frequency, rng.uniform(0.0, 2.0 * np.pi, _TERMS), sd * np.sqrt(2.0 / _TERMS))

    def relief(self, grid: Grid, columns: Int[np.ndarray, " c"]) -> Float[np.ndarray, "n c"]:
        n, step = len(grid.station), grid.station[1]
        # exp(i a (j + k)) = exp(i a j) exp(i a k): a few hundred sines a cosine instead of one a station.
        fine = np.exp(1j * step * np.outer(np.arange(_CHUNK), self.frequency[:, 0]))
        coarse = np.exp(1j * step * _CHUNK * np.outer(np.arange(-(-n // _CHUNK)), self.frequency[:, 0]))
        around = np.exp(1j * (np.outer(grid.girth[columns], self.frequency[:, 1]) + self.phase)).T
        along = (coarse[:, None] * fine).reshape(-1, len(self.phase))[:n]
        # The real part of a product of complex matrices, as one product of real ones: many small ones keep the threads
        # of BLAS waiting for each other.
        waves = np.hstack([along.real, -along.imag]) @ np.vstack([around.real, around.imag])
        return np.round(self.amplitude * waves, _DIGITS)


@dataclasses.dataclass(frozen=True)
class Rings:
    """Rings of segments, each segment a little out of place."""

    nominal: float  # ring length on the drawings, m
    joint: Float[np.ndarray, " r"]  # stations of the ring joints as built, m, `(r,)`
    turn: Float[np.ndarray, " rings"]  # turn of each ring, rad, `(r + 1,)`
    edge: Float[np.ndarray, " g"]  # angles at which segments of an unturned ring begin, rad, growing, `(g,)`
    place: Float[np.ndarray, "rings g"]  # radial place of each segment, m, `(r + 1, g)`
    oval: float  # excess of the horizontal radius, m

    @classmethod
    def draw(cls, rng: np.random.Generator, ranges: RingRanges, length: float, radius: float, bolts: int) -> Rings:
        """Draw the rings of a tunnel; a turned ring is turned by a whole number of bolts, so that bolts meet."""
        nominal = round(float(rng.uniform(*ranges.nominal)), 2)
        built = nominal * (1.0 + rng.uniform(*ranges.gasket))
        count = int(length / built) + 2
        lengths = built + rng.normal(0.0, ranges.length_sd, count)
        joint = rng.uniform(0.0, built) + np.concatenate([[0.0], np.cumsum(lengths)])
        joint = joint[joint < length]
        segments = int(rng.integers(ranges.segments[0], ranges.segments[1] + 1))
        # The key is a third as wide as the others.
        fraction = np.concatenate([[1.0 / 3.0], np.ones(segments - 1)])
        edge = 2.0 * np.pi * np.cumsum(fraction / fraction.sum())
        first = rng.uniform(0.0, 2.0 * np.pi)
        places = rng.integers(0, bolts, len(joint) + 1) if ranges.turned else np.zeros(len(joint) + 1)
        return cls(
            nominal=nominal,
            joint=joint,
            turn=first + 2.0 * np.pi / bolts * places,
            edge=edge - edge[0],
            place=rng.normal(0.0, rng.uniform(*ranges.step_sd), (len(joint) + 1, segments)),
            oval=radius * rng.uniform(*ranges.oval),
        )

    def relief(self, grid: Grid, columns: Int[np.ndarray, " c"]) -> Float[np.ndarray, "n c"]:
        """Return ovality and the places of the segments, m."""
        ring = np.searchsorted(self.joint, grid.station)
        angle = np.mod(grid.bearing[columns] - self.turn[:, None], 2.0 * np.pi)
        segment = np.searchsorted(self.edge, angle, side="right") - 1
        placed = np.take_along_axis(self.place, segment, axis=1)
        return placed[ring] + self.oval * np.cos(2.0 * grid.bearing[columns])


@dataclasses.dataclass(frozen=True)
class Stretches:
    """Blocks, rounds or repaired stretches."""

    joint: Float[np.ndarray, " r"]  # stations where one ends and the next begins, m, `(r,)`
    offset: Float[np.ndarray, " stretches"]  # radial place of each, m, `(r + 1,)`
    shift: Float[np.ndarray, "stretches 2"]  # place of each to the left and upwards, m, `(r + 1, 2)`
    flare: float  # growth of the radius over a stretch, m

    @classmethod
    def draw(cls, rng: np.random.Generator, ranges: StretchRanges, length: float) -> Stretches:
        """Draw the stretches of a tunnel; the last is as long as what is left."""
        usual = rng.uniform(*ranges.length)
        lengths = usual * np.maximum(1.0 + ranges.jitter * rng.normal(size=int(2.0 * length / usual) + 8), 0.3)
        joint = np.cumsum(lengths)
        joint = joint[joint < length]
        count = len(joint) + 1
        repaired = rng.random(count) < rng.uniform(*ranges.repaired)
        offset = rng.normal(0.0, rng.uniform(*ranges.offset_sd), count) - repaired * rng.uniform(*ranges.thickness)
        shift = rng.normal(0.0, rng.uniform(*ranges.shift_sd), (count, 2))
        return cls(joint, offset, shift, float(rng.uniform(*ranges.flare)))

    def relief(self, grid: Grid, columns: Int[np.ndarray, " c"]) -> Float[np.ndarray, "n c"]:
        """Return the places of the stretches, m; a flare is as much too narrow at one end as too wide at the other."""
        which = np.searchsorted(self.joint, grid.station)
        ends = np.concatenate([[0.0], self.joint, grid.station[-1:] + 1e-9])
        fraction = (grid.station - ends[which]) / (ends[which + 1] - ends[which])
        along = self.offset[which] + self.flare * (fraction - 0.5)
        angle = grid.bearing[columns]
        aside = self.shift[which] @ np.stack([np.cos(angle), np.sin(angle)])
        return along[:, None] + aside


@dataclasses.dataclass(frozen=True)
class Patches:
    """Rectangles that stand a little out of the wall or in it."""

    station: Float[np.ndarray, "p 2"]  # their begins and ends, m, `(p, 2)`
    girth: Float[np.ndarray, "p 2"]  # their edges around the section, m, `(p, 2)`
    relief_of: Float[np.ndarray, " p"]  # distance of the wall outside the section there, m, `(p,)`

    @classmethod
    def draw(cls, rng: np.random.Generator, ranges: PatchRanges, length: float, around: float) -> Patches:
        count = int(rng.poisson(length / rng.uniform(*ranges.spacing)))
        middle = np.column_stack([rng.uniform(0.0, length, count), rng.uniform(0.0, around, count)])
        half = 0.5 * rng.uniform(*ranges.size, (count, 2))
        sides = np.stack([middle - half, middle + half], axis=-1)
        return cls(sides[:, 0], sides[:, 1], rng.normal(0.0, rng.uniform(*ranges.relief), count))

    def relief(self, grid: Grid, columns: Int[np.ndarray, " c"]) -> Float[np.ndarray, "n c"]:
        """Return the patches, m; where two overlap they add."""
        total = np.zeros((len(grid.station), len(columns)))
        first, last = (np.searchsorted(grid.station, self.station[:, i]) for i in range(2))
        girth = grid.girth[columns]
        for i, value in enumerate(self.relief_of):
            total[first[i] : last[i]] += value * ((girth >= self.girth[i, 0]) & (girth < self.girth[i, 1]))
        return total


@runtime_checkable
class Layer(Protocol):
    """One cause of relief; the relief of a wall is the sum of its layers."""

    def relief(self, grid: Grid, columns: Int[np.ndarray, " c"]) -> Float[np.ndarray, "n c"]:
        """Return how far the wall lies outside the design section, m, at all stations and some angles of a grid."""


def draw_layers(
    rng: np.random.Generator, kind: Kind, length: float, radius: float, around: float, bolts: int
) -> list[Layer]:
    """Draw the relief of a kind of lining: length of the tunnel, half its width, girth, m; bolts of a ring joint."""
    surface = kind.surface
    layers: list[Layer] = []
    if kind.rings is not None:
        layers.append(Rings.draw(rng, kind.rings, length, radius, bolts))
    if kind.stretches is not None:
        layers.append(Stretches.draw(rng, kind.stretches, length))
    if kind.patches is not None:
        layers.append(Patches.draw(rng, kind.patches, length, around))
    fine = float(np.exp(rng.uniform(*np.log(surface.fine_length))))
    layers.append(Waves.draw(rng, float(rng.uniform(*surface.fine_sd)), fine))
    layers.append(Waves.draw(rng, float(rng.uniform(*surface.coarse_sd)), float(rng.uniform(*surface.coarse_length))))
    return layers
