"""The true section: a D with flat floor, vertical walls and semicircular crown, varying along the bore.

Heights count from the floor, angles of the crown from its left springing over the top to the right. The floor is
exactly flat across; walls and crown carry a small roughness along their normals.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from scene.survey.field import Field, draw_field
from scene.survey.furniture import CROWN_ROWS, POCKET_WIDTH, WALL_ROWS, Row

WIDTH = 5.65  # m, mean
HEIGHT = 6.36  # m, mean
CELL = 0.10  # m, largest cell of the surface grid
_HALF_POCKET = 0.5 * POCKET_WIDTH * np.array([-1.0, 0.0, 1.0])  # m: first edge, middle, last edge of a pocket
_FIXED = 2.6  # m: nodes of the wall up to here keep their height; those above stretch to the springing


def refine(breaks: Float[np.ndarray, "b"], cell: float) -> Float[np.ndarray, "n"]:
    """The sorted, distinct `breaks` with equal cells no larger than `cell` between neighbours."""
    breaks = np.unique(np.round(breaks, 9))
    counts = np.ceil(np.diff(breaks) / cell - 1e-9).astype(int)
    parts = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(breaks, breaks[1:], counts, strict=False)]
    return np.concatenate([*parts, breaks[-1:]])


@dataclass(frozen=True)
class Section:
    """Section by station, on a fixed set of nodes from the left foot over the crown to the right foot.

    Attributes:
        width_field, height_field: Slow deviations from the mean width and height, m.
        roughness: Deviation along the outward normal by station and girth, m.
        wall: Heights of the nodes of one wall at the mean section, m, from the floor to below the springing.
        theta: Angles of the crown's nodes, rad, from 0 (left springing) to π.
    """

    width_field: Field
    height_field: Field
    roughness: Field
    wall: Float[np.ndarray, "w"]
    theta: Float[np.ndarray, "c"]

    def width(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Width between the smooth walls, m."""
        return WIDTH + self.width_field.along(station)

    def height(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Height from the floor to the smooth crown, m."""
        return HEIGHT + self.height_field.along(station)

    @property
    def normal(self) -> Float[np.ndarray, "m 2"]:
        """Outward normals of the smooth section at the nodes, along `lateral` and `up`."""
        side = np.stack([np.ones_like(self.wall), np.zeros_like(self.wall)], axis=-1)
        crown = np.stack([np.cos(self.theta), np.sin(self.theta)], axis=-1)
        return np.concatenate([side, crown, side * (-1.0, 1.0)])

    @property
    def girth(self) -> Float[np.ndarray, "m"]:
        """Distance of the nodes from the left foot along the mean section, m."""
        spring, radius = HEIGHT - 0.5 * WIDTH, 0.5 * WIDTH
        right = 2.0 * spring + np.pi * radius - self.wall[::-1]
        return np.concatenate([self.wall, spring + radius * self.theta, right])

    def smooth(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n m 2"]:
        """Nodes of the smooth section about the centreline, m along `lateral` and `up`."""
        radius, height = 0.5 * self.width(station)[:, None], self.height(station)[:, None]
        # Springing moves with width and height; the upper part of the wall stretches to meet it.
        stretch = (height - radius - _FIXED) / (HEIGHT - 0.5 * WIDTH - _FIXED)
        up = np.where(self.wall > _FIXED, _FIXED + (self.wall - _FIXED) * stretch, self.wall) - 0.5 * height
        crown_y, crown_z = radius * np.cos(self.theta), 0.5 * height - radius + radius * np.sin(self.theta)
        y = np.concatenate([np.broadcast_to(radius, up.shape), crown_y, np.broadcast_to(-radius, up.shape)], axis=1)
        return np.stack([y, np.concatenate([up, crown_z, up[:, ::-1]], axis=1)], axis=-1)

    def rough(self, station: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n m 2"]:
        """Nodes of the actual lining, without pockets, about the centreline, m."""
        return self.smooth(station) + self.roughness.over(station, self.girth)[..., None] * self.normal

    def row_nodes(self, row: Row) -> Int[np.ndarray, "3"]:
        """Nodes at the first edge, the middle and the last edge of a row of pockets, in the order of the nodes."""
        total = 2 * len(self.wall) + len(self.theta)
        if row.on == "wall":
            at = [int(np.argmin(abs(self.wall - h))) for h in row.at + _HALF_POCKET]
        else:
            angles = row.at + _HALF_POCKET / (0.5 * WIDTH)
            at = [len(self.wall) + int(np.argmin(abs(self.theta - a))) for a in angles]
        return np.array(at if row.side > 0 else [total - 1 - i for i in reversed(at)])

    def measure(self, station: Float[np.ndarray, "n"]) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Largest inner width and floor-to-crown height on the axis of the actual lining, pockets excepted, m."""
        nodes = self.rough(station)
        top = len(self.wall) + int(np.argmin(abs(self.theta - 0.5 * np.pi)))
        width = np.empty(len(station))
        for i, (y, z) in enumerate(np.moveaxis(nodes, -1, 1)):
            level = np.arange(z[0], z[top] - 0.5, 0.01)
            left, right = np.s_[: top + 1], np.s_[: top - 1 : -1]
            width[i] = (np.interp(level, z[left], y[left]) - np.interp(level, z[right], y[right])).max()
        return width, nodes[:, top, 1] + 0.5 * self.height(station)


def draw_section(rng: np.random.Generator) -> Section:
    """Draw a section: width and height vary by 5 cm (1 σ) over 8 to 15 m, the surface by 1 cm over 1 to 2 m."""
    radius = 0.5 * WIDTH
    heights = np.add.outer(WALL_ROWS, _HALF_POCKET).ravel()
    wall = refine(np.concatenate([[0.0, _FIXED, HEIGHT - radius], heights]), CELL)[:-1]
    angles = np.add.outer(CROWN_ROWS, _HALF_POCKET / radius).ravel()
    theta = refine(np.concatenate([[0.0, 0.5 * np.pi], angles]), CELL / radius)
    return Section(
        width_field=draw_field(rng, 0.05, rng.uniform(8.0, 15.0)),
        height_field=draw_field(rng, 0.05, rng.uniform(8.0, 15.0)),
        roughness=draw_field(rng, 0.01, rng.uniform(1.0, 2.0), dims=2, terms=256),
        wall=wall,
        theta=np.concatenate([theta, np.pi - theta[-2::-1]]),
    )
