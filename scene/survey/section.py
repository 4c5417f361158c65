"""The true section by station: an outline of varying size, with roughness along its normals, on a straight floor."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from scene.survey.field import Field
from scene.survey.shape import Shape


@dataclass(frozen=True)
class Trend:
    """A smooth function of station through knots, constant beyond them.

    Attributes:
        station: Knots, m.
        value: There, m.
    """

    station: tuple[float, ...] = (0.0, 1.0)
    value: tuple[float, ...] = (0.0, 0.0)

    def __call__(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Values at `station`, m."""
        return PchipInterpolator(self.station, self.value)(np.clip(station, self.station[0], self.station[-1]))


@dataclass(frozen=True)
class Measures:
    """Sizes of the actual sections, pockets excepted.

    Attributes:
        width: Largest horizontal distance between the walls, m.
        height: Floor to crown on the axis, m.
        middle: Middle of the width (where it is largest) and of the height, along `lateral` and `up` from the
            centreline, m. Not zero where walls and crown are rough.
    """

    width: Float[np.ndarray, "n"]
    height: Float[np.ndarray, "n"]
    middle: Float[np.ndarray, "n 2"]


@dataclass(frozen=True)
class Section:
    """Section by station, on the nodes of a shape.

    Attributes:
        shape: The outline.
        width_field, height_field: Slow deviations from its width and height, m.
        roughness: Deviation along the outward normal by station and girth, m.
        widening: Further width by station, m.
        crossfall: Rise of the floor towards the left, m/m; on the axis it lies half the height below the centreline.
    """

    shape: Shape
    width_field: Field
    height_field: Field
    roughness: Field
    widening: Trend = field(default_factory=Trend)
    crossfall: float = 0.0

    def width(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Largest width between the smooth walls, m."""
        return self.shape.width + self.width_field.along(station) + self.widening(station)

    def height(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Height from the floor to the smooth crown on the axis, m."""
        return self.shape.height + self.height_field.along(station)

    def _on_floor(self, nodes: Float[np.ndarray, "n m 2"], height: Float[np.ndarray, "n"]) -> None:
        for foot in (0, -1):
            nodes[:, foot, 1] = self.crossfall * nodes[:, foot, 0] - 0.5 * height

    def smooth(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n m 2"]:
        """Nodes of the smooth section about the centreline, m along `lateral` and `up`."""
        height = self.height(station)
        nodes = self.shape.scaled(self.width(station), height)
        nodes[..., 1] -= 0.5 * height[:, None]
        self._on_floor(nodes, height)
        return nodes

    def rough(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n m 2"]:
        """Nodes of the actual lining, without pockets, about the centreline, m."""
        nodes = self.smooth(station)
        nodes += self.roughness.over(station, self.shape.girth)[..., None] * self.shape.normal
        self._on_floor(nodes, self.height(station))
        return nodes

    def measure(self, station: Float[np.ndarray, "n"]) -> Measures:
        """Sizes of the actual lining at `station`, m."""
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
