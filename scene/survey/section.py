"""The true section by station: an outline of varying size, with roughness along its normals, on a straight floor."""

from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import PchipInterpolator

from scene.survey.furniture import POCKET_WIDTH, SLEEPER_RISE


@dataclass(frozen=True)
class Field:
    """Zero-mean, nearly Gaussian random function with the correlation exp(-(d / c)²).

    It is defined everywhere, has all derivatives and needs no grid.

    Source: Rahimi and Recht 2007, random Fourier features of the squared-exponential kernel.
    """

    frequency: Float[np.ndarray, "k d"]  # Angular frequencies, rad per unit of the argument
    phase: Float[np.ndarray, "k"]  # Phases, rad
    amplitude: float  # Amplitude of each cosine; the standard deviation times sqrt(2 / k)

    def along(self, x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return values of a field of one argument."""
        return self.amplitude * np.cos(np.outer(x, self.frequency[:, 0]) + self.phase).sum(axis=1)

    def over(self, x: Float[np.ndarray, "n"], y: Float[np.ndarray, "m"]) -> Float[np.ndarray, "n m"]:
        """Return values of a field of two arguments on the grid of `x` and `y`."""
        a = np.outer(x, self.frequency[:, 0]) + self.phase
        b = np.outer(y, self.frequency[:, 1])
        return self.amplitude * (np.cos(a) @ np.cos(b).T - np.sin(a) @ np.sin(b).T)


def draw_field(rng: np.random.Generator, sigma: float, correlation: float, dims: int = 1, terms: int = 96) -> Field:
    """Draws a field of `dims` arguments as a sum of `terms` cosines.

    `sigma` is the standard deviation of its values. Over `correlation`, in the unit of the argument, the correlation
    falls to 1/e.
    """
    frequency = rng.normal(0.0, np.sqrt(2.0) / correlation, size=(terms, dims))
    return Field(frequency, rng.uniform(0.0, 2.0 * np.pi, terms), sigma * np.sqrt(2.0 / terms))


CELL = 0.10  # m, largest cell of the surface grid
_OUTLINE_STEP = 1e-3  # m between the points of an outline before it is sampled
_HALF_POCKET = 0.5 * POCKET_WIDTH * np.array([-1.0, 0.0, 1.0])  # m: first edge, middle, last edge of a pocket
# Middles of the rows of pockets: on the wall in m above the floor (the first 0.70 m above the sleepers), on the crown
# as a fraction of the height, which in the paper's D is 35° and 70° above the springing.
_WALL_ROWS = (SLEEPER_RISE + 0.70, 2.20)
_CROWN_ROWS = ((3.535 + 2.825 * np.sin(np.deg2rad([35.0, 70.0]))) / 6.36).tolist()


def refine_breaks(breaks: Float[np.ndarray, "b"], cell: float) -> Float[np.ndarray, "n"]:
    """Return the sorted, distinct `breaks` with equal cells no larger than `cell` between neighbours."""
    breaks = np.unique(np.round(breaks, 9))
    counts = np.ceil(np.diff(breaks) / cell - 1e-9).astype(int)
    parts = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(breaks, breaks[1:], counts, strict=False)]
    return np.concatenate([*parts, breaks[-1:]])


@dataclass(frozen=True)
class Shape:
    """One outline at its nominal size; other sizes stretch it across and upright."""

    width: float  # Nominal largest width, m
    height: float  # Nominal height from floor to crown, m
    nodes: Float[np.ndarray, "m 2"]  # Along `lateral`, and above the floor, m
    # Outward normals; horizontal at the feet, so that roughness does not lift them off the floor
    normal: Float[np.ndarray, "m 2"]
    girth: Float[np.ndarray, "m"]  # Distance of the nodes from the left foot along the outline, m
    # Nodes at the first edge, the middle and the last edge of each row of pockets, the left side first
    rows: Int[np.ndarray, "k 3"]

    @property
    def top(self) -> int:
        """The node at the crown, on the axis."""
        return len(self.nodes) // 2

    def scaled(self, width: Float[np.ndarray, "n"], height: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n m 2"]:
        return self.nodes * np.stack([width / self.width, height / self.height], axis=-1)[:, None]


@dataclass(frozen=True)
class DShape(Shape):
    """A D whose crown stays a semicircle: of other sizes the walls move, and stretch above `fixed` to the springing."""

    fixed: float = 2.6  # Nodes up to this height above the floor keep it, m
    spring: float = 3.535  # Nominal height of the springing above the floor, m

    def scaled(self, width: Float[np.ndarray, "n"], height: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n m 2"]:
        radius = 0.5 * width[:, None]
        spring = height[:, None] - radius
        y, z = self.nodes.T
        stretch = (spring - self.fixed) / (self.spring - self.fixed)
        wall = np.where(z > self.fixed, self.fixed + (z - self.fixed) * stretch, z)
        ratio = radius / (0.5 * self.width)
        return np.stack([y * ratio, np.where(z > self.spring, spring + (z - self.spring) * ratio, wall)], axis=-1)


S = TypeVar("S", bound=Shape)


def _arc(centre: tuple[float, float], radius: float, begin: float, end: float) -> Float[np.ndarray, "n 2"]:
    angle = np.linspace(begin, end, int(np.ceil(radius * abs(end - begin) / _OUTLINE_STEP)) + 1)
    return np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _sample_half(kind: type[S], half: Float[np.ndarray, "n 2"], breaks: tuple[float, ...] = ()) -> S:
    """Return the shape whose left half, foot to crown, is a dense outline (lateral, above the floor), m.

    Nodes lie at the heights `breaks` above the floor, m.
    """
    half = half[np.concatenate([[True], np.linalg.norm(np.diff(half, axis=0), axis=1) > 1e-9])]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(half, axis=0), axis=1))])
    height = half[-1, 1]
    middles = np.interp([*_WALL_ROWS, *(fraction * height for fraction in _CROWN_ROWS)], half[:, 1], along)
    edges = np.add.outer(middles, _HALF_POCKET)
    girth = refine_breaks(np.concatenate([[0.0, along[-1]], edges.ravel(), np.interp(breaks, half[:, 1], along)]), CELL)
    left = np.stack([np.interp(girth, along, v) for v in half.T], axis=-1)
    slope = np.gradient(half, along, axis=0)
    normal = np.stack([np.interp(girth, along, slope[:, 1]), -np.interp(girth, along, slope[:, 0])], axis=-1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    left[-1, 0], normal[0], normal[-1] = 0.0, (1.0, 0.0), (0.0, 1.0)

    rows = np.array([[int(np.argmin(abs(girth - e))) for e in row] for row in edges])
    total = 2 * len(girth) - 1
    mirror = (-1.0, 1.0)
    return kind(
        width=2.0 * float(half[:, 0].max()),
        height=float(height),
        nodes=np.concatenate([left, left[-2::-1] * mirror]),
        normal=np.concatenate([normal, normal[-2::-1] * mirror]),
        girth=np.concatenate([girth, 2.0 * along[-1] - girth[-2::-1]]),
        rows=np.concatenate([rows, total - 1 - rows[:, ::-1]]),
    )


def _d_half() -> Float[np.ndarray, "n 2"]:
    wall = np.stack([np.full(3536, 2.825), np.linspace(0.0, 3.535, 3536)], axis=-1)
    return np.concatenate([wall, _arc((0.0, 3.535), 2.825, 0.0, 0.5 * np.pi)])


def d_shape() -> DShape:
    """Return the paper's D, 5.65 m by 6.36 m: flat floor, vertical walls, semicircular crown."""
    return _sample_half(DShape, _d_half(), (2.6, 3.535))


def arch() -> Shape:
    """Return the same D, whose crown becomes elliptical where the width changes."""
    return _sample_half(Shape, _d_half())


def horseshoe() -> Shape:
    """Return a semicircular crown of 2.9 m on walls that draw in, along arcs of 6 m, to 4.19 m at the floor."""
    wall = _arc((2.9 - 6.0, 3.0), 6.0, -np.arcsin(3.0 / 6.0), 0.0)
    return _sample_half(Shape, np.concatenate([wall, _arc((0.0, 3.0), 2.9, 0.0, 0.5 * np.pi)]))


def circle() -> Shape:
    """Return a shield bore of 2.898 m radius, as the real metro's rings, its invert filled flat to a depth of 0.9 m."""
    radius, fill = 2.898, 0.9
    return _sample_half(Shape, _arc((0.0, radius - fill), radius, np.arcsin(fill / radius - 1.0), 0.5 * np.pi))


@dataclass(frozen=True)
class Trend:
    """A smooth function of station through knots, constant beyond them."""

    station: tuple[float, ...] = (0.0, 1.0)  # Knots, m
    value: tuple[float, ...] = (0.0, 0.0)  # Value at each knot, m

    def __call__(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        return PchipInterpolator(self.station, self.value)(np.clip(station, self.station[0], self.station[-1]))


@dataclass(frozen=True)
class Measures:
    """Sizes of the actual sections, pockets excepted."""

    width: Float[np.ndarray, "n"]  # Largest horizontal distance between the walls, m
    height: Float[np.ndarray, "n"]  # Floor to crown on the axis, m
    # Middle of the width (where it is largest) and of the height, along `lateral` and `up` from the centreline, m. Not
    # zero where walls and crown are rough
    middle: Float[np.ndarray, "n 2"]


@dataclass(frozen=True)
class Section:
    """Section by station, on the nodes of a shape."""

    shape: Shape  # The outline
    width_field: Field  # Slow deviation from its width, m
    height_field: Field  # Slow deviation from its height, m
    roughness: Field  # Deviation along the outward normal by station and girth, m
    widening: Trend = field(default_factory=Trend)  # Further width by station, m
    # Rise of the floor towards the left, m/m; on the axis it lies half the height below the centreline
    crossfall: float = 0.0

    def width(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the largest width between the smooth walls, m."""
        return self.shape.width + self.width_field.along(station) + self.widening(station)

    def height(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the height from the floor to the smooth crown on the axis, m."""
        return self.shape.height + self.height_field.along(station)

    def _on_floor(self, nodes: Float[np.ndarray, "n m 2"], height: Float[np.ndarray, "n"]) -> None:
        for foot in (0, -1):
            nodes[:, foot, 1] = self.crossfall * nodes[:, foot, 0] - 0.5 * height

    def smooth(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n m 2"]:
        """Return nodes of the smooth section about the centreline, m along `lateral` and `up`."""
        height = self.height(station)
        nodes = self.shape.scaled(self.width(station), height)
        nodes[..., 1] -= 0.5 * height[:, None]
        self._on_floor(nodes, height)
        return nodes

    def rough(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n m 2"]:
        """Return nodes of the actual lining, without pockets, about the centreline, m."""
        nodes = self.smooth(station)
        nodes += self.roughness.over(station, self.shape.girth)[..., None] * self.shape.normal
        self._on_floor(nodes, self.height(station))
        return nodes

    def measure(self, station: Float[np.ndarray, "n"]) -> Measures:
        """Measures the actual lining at `station`, m."""
        nodes, top = self.rough(station), self.shape.top
        width, across = np.empty(len(station)), np.empty(len(station))
        for i, (y, z) in enumerate(np.moveaxis(nodes, -1, 1)):
            # Both walls are straight between nodes, so that their distance is largest at the level of one of them.
            level = z[(z >= max(z[0], z[-1])) & (z <= z[top] - 0.5)]
            left = np.interp(level, np.maximum.accumulate(z[: top + 1]), y[: top + 1])
            right = np.interp(level, np.maximum.accumulate(z[: top - 1 : -1]), y[: top - 1 : -1])
            widest = int(np.argmax(left - right))
            width[i], across[i] = left[widest] - right[widest], 0.5 * (left[widest] + right[widest])
        crown, half = nodes[:, top, 1], 0.5 * self.height(station)
        return Measures(width, crown + half, np.stack([across, 0.5 * (crown - half)], axis=-1))
