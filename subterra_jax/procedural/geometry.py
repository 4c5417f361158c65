"""The ranges of a family of tunnels; its centrelines; and walls, recesses and furniture beside them, in float64."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from subterra_jax.host.errors import SubterraError
from subterra_jax.tunnel.plan import Wall

Range = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class ProceduralConfig:
    """Ranges of a family of tunnels. A pair is the least and the largest value; draws are uniform unless said.

    Source: widths and pockets are those of the packaged bore (5.65 m between the walls at LiDAR height, pockets 0.20 m
    long, 0.13 m deep and 0.22 m from the joint), the rest metro practice; radii go down to 60 m where 150 to 300 m are
    usual.

    Attributes:
        length: Length of the centreline, m.
        radius: Radius of a bend, m, drawn uniformly in its logarithm.
        straight: Length between two bends, m.
        arc: Length of constant curvature, m.
        transition: Length of each clothoid, over which the curvature changes evenly, m.
        turn: Largest turn of one bend, without its clothoids, rad.
        reverse_share: Share of bends followed by the opposite bend without a straight.
        width: Mean distance between the smooth walls, m.
        width_sd: Standard deviation of the width's slow variation along one tunnel, m.
        width_wave: Correlation length of that variation, m.
        roughness: Standard deviation of each wall about its smooth line, m.
        correlation: Correlation length of that roughness, m.
        ring_pitch: Distance between ring joints, m.
        pocket_depth: Depth of the recesses, m.
        pocket_length: Length of a recess along the wall, m.
        pocket_offset: Distance of a recess's middle from its joint, m; there is one on either side of a joint.
        pocket_missing: Share of recesses left out.
        one_wall_share: Share of tunnels in which the LiDAR plane crosses a row of recesses on one wall only.
        bracket_spacing: Distance between cable brackets on the right wall of the furnished lining, m.
        post_spacing: Distance between handrail posts on the left of the furnished lining, m.
        lidar_height: Height of the LiDAR plane above the floor, m; recorded only, since the family is planar.
        grid_step: Step of the station grid, m.
        wall_step: Distance between two vertices of a smooth wall, m.
    """

    length: Range = (200.0, 500.0)
    radius: Range = (60.0, 1000.0)
    straight: Range = (15.0, 70.0)
    arc: Range = (20.0, 90.0)
    transition: Range = (10.0, 30.0)
    turn: float = 1.6
    reverse_share: float = 0.3
    width: Range = (5.085, 6.215)
    width_sd: Range = (0.0, 0.02)
    width_wave: Range = (15.0, 40.0)
    roughness: Range = (0.0, 0.015)
    correlation: Range = (0.5, 3.0)
    ring_pitch: Range = (1.2, 1.5)
    pocket_depth: Range = (0.05, 0.15)
    pocket_length: Range = (0.15, 0.25)
    pocket_offset: Range = (0.18, 0.28)
    pocket_missing: Range = (0.0, 0.3)
    one_wall_share: float = 0.3
    bracket_spacing: Range = (1.8, 2.2)
    post_spacing: Range = (1.8, 2.2)
    lidar_height: float = 0.7
    grid_step: float = 0.25
    wall_step: float = 0.35

    def check(self) -> None:
        """Check that tunnels can be drawn from the ranges.

        Raises:
            ValueError: A range is empty or not positive, a share is outside [0, 1], or recesses would overlap.
        """
        may_be_zero = {"width_sd", "roughness", "pocket_missing"}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            low, high = value if isinstance(value, tuple) else (value, value)
            least_ok = low >= 0.0 if field.name in may_be_zero or field.name.endswith("_share") else low > 0.0
            if not (least_ok and low <= high):
                raise ValueError(f"{field.name} of the family must be positive and not empty, got {value}")
            if (field.name.endswith("_share") or field.name == "pocket_missing") and high > 1.0:
                raise ValueError(f"{field.name} of the family must be at most 1, got {value}")
        if self.pocket_length[1] >= min(2.0 * self.pocket_offset[0], self.ring_pitch[0] - 2.0 * self.pocket_offset[1]):
            raise ValueError(
                f"recesses of {self.pocket_length} m at {self.pocket_offset} m from joints "
                f"{self.ring_pitch} m apart would overlap"
            )


# Parts of a tunnel more than _ALONG apart along it stay more than _APART from one another, m: a LiDAR with a reach of
# 30 m never sees into another part, and no window of walls need hold two.
_ALONG, _APART, _SAMPLE = 60.0, 40.0, 2.0
_TRIES = 200


@dataclasses.dataclass(frozen=True)
class Alignment:
    """A centreline in plan that starts at the origin along x.

    Attributes:
        knot: Stations at which the curvature's slope changes, from 0, m, `(k,)`.
        curvature: Curvature there, to the left positive, 1/m, `(k,)`; linear between, which makes clothoids.
        length: Length of the centreline, m.
        step: Distance of the nodes for integrating positions, m.
    """

    knot: Float[np.ndarray, " k"]
    curvature: Float[np.ndarray, " k"]
    length: float
    step: float

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
        """Return the unit tangent."""
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


def draw_alignment(rng: np.random.Generator, length: float, config: ProceduralConfig) -> Alignment:
    """Draw a centreline of bends and straights that stays clear of itself.

    Args:
        rng: Source of randomness.
        length: Length, m.
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
    """Draw knots of the curvature until beyond the length."""
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
    """Return whether all distant parts stay clear of one another."""
    station = np.arange(0.0, alignment.length, _SAMPLE)
    x, y = alignment.position(station).T
    apart = int(_ALONG / _SAMPLE)
    first, second = np.triu_indices(len(station), k=apart)
    near = (x[first] - x[second]) ** 2 + (y[first] - y[second]) ** 2 < _APART**2
    return not near.any()


_FINE = 8  # samples of a random line in one correlation length
_END = 0.1  # ends of a tunnel without recesses, m
BRACKET, POST, RAIL, AIR = 0.05, 0.05, 0.15, 0.01  # sides of both; gaps behind posts and brackets, m


def wander(
    rng: np.random.Generator, station: Float[np.ndarray, " n"], sd: float, correlation: float
) -> Float[np.ndarray, " n"]:
    """Draw a smooth random line along the tunnel: Gaussian, with covariance `sd² exp(−d² / correlation²)`.

    Args:
        rng: Source of randomness.
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


def wall(
    alignment: Alignment, side: float, station: Float[np.ndarray, " n"], distance: Float[np.ndarray, " n"]
) -> Wall:
    """Return a wall `distance` metres to the left (`side` 1) or right (−1) of the centreline."""
    return Wall(vertex=alignment.offset(station, side * distance), station=station)


def recess_starts(
    rng: np.random.Generator, joint: Float[np.ndarray, " j"], offset: float, length: float, missing: float, end: float
) -> Float[np.ndarray, " p"]:
    """Draw the stations at which the recesses of one row begin, m: two per joint, less the missing ones.

    Args:
        rng: Source of randomness.
        joint: Ring joints, m.
        offset: Distance of a recess's middle from its joint, m.
        length: Length of a recess, m.
        missing: Share to leave out.
        end: Length of the tunnel, m; recesses across its end are left out too.
    """
    starts = (joint[:, None] + np.array([-offset, offset]) - 0.5 * length).ravel()
    there = rng.random(len(starts)) >= missing
    return starts[there & (starts > _END) & (starts + length < end - _END)]


def outlines(
    alignment: Alignment, station: Float[np.ndarray, " f"], near: Float[np.ndarray, " f"],
    far: Float[np.ndarray, " f"], length: float,
) -> Float[np.ndarray, "g 4"]:  # fmt: skip
    """Return closed outlines of boxes beside the centreline as segments `x0, y0, x1, y1`, m.

    Args:
        alignment: The centreline.
        station: Stations of the boxes' middles, m.
        near: One side of each box, m to the left of the centreline.
        far: The other side, m to the left of the centreline.
        length: Length of each box along the tunnel, m.
    """
    before, after = station - 0.5 * length, station + 0.5 * length
    corners = [alignment.offset(s, d) for s, d in ((before, near), (after, near), (after, far), (before, far))]
    outline = np.stack(corners, axis=1)
    return np.concatenate([outline, np.roll(outline, -1, axis=1)], axis=2).reshape(-1, 4)
