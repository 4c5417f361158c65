"""Air in rock: solids in straight coordinates (station, left, up), joined and cut, then bent along an alignment.

Station 0 is the first mouth, `left` is 0 on the axis, `up` is 0 on the floor, all in m.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from manifold3d import CrossSection, Manifold, Mesh

_ARC = 72  # corners of a half circle
_FACET = 0.5  # m between the corners of a bent surface: 0.4 mm off a radius of 80 m


@dataclass(frozen=True)
class Arch:
    """A section of upright walls under half an ellipse on a flat floor."""

    width: float = 5.5  # m
    height: float = 5.5  # m, floor to crown
    springing: float = 2.75  # m above the floor, where the walls end

    def outline(self, grow: float = 0.0) -> Float[np.ndarray, "k 2"]:
        """Return the corners, counter-clockwise, left and up, m; walls and crown moved out by `grow`, m."""
        turn = np.linspace(0.0, np.pi, _ARC + 1)
        half, rise = 0.5 * self.width + grow, self.height - self.springing + grow
        crown = np.stack([half * np.cos(turn), self.springing + rise * np.sin(turn)], axis=1)
        return np.concatenate([crown, [[-half, 0.0], [half, 0.0]]])

    def depth(self, left: Float[np.ndarray, " p"], up: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Return about how far places lie behind the walls and crown, m; negative in the air."""
        half, rise = 0.5 * self.width, self.height - self.springing
        above = np.hypot(left / half, (up - self.springing) / rise)
        return np.where(up > self.springing, (above - 1.0) * min(half, rise), np.abs(left) - half)


def prism(outline: Float[np.ndarray, "k 2"], start: float, end: float) -> Manifold:
    """Return an outline, left and up, swept from one station to another, m."""
    solid = Manifold.extrude(CrossSection([outline]), end - start)
    # The extrusion grows along its third axis: left, up, station become station, left, up.
    turn = np.array([[0.0, 0.0, 1.0, start], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    return solid.transform(turn)


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Manifold:
    """Return a box between two corners: station, left, up, m."""
    return Manifold.cube(np.subtract(high, low)).translate(low)


def trapezoid(bottom: float, slope: float, height: float) -> Float[np.ndarray, "4 2"]:
    """Return the section of a cutting: half-width of its bottom, m, run of its slopes over their rise, height, m."""
    top = bottom + slope * height
    return np.array([[bottom, 0.0], [top, height], [-top, height], [-bottom, 0.0]])


@dataclass(frozen=True)
class Alignment:
    """An arc with a grade, somewhere in the survey frame."""

    yaw: float = 0.0  # Heading at station 0, rad
    radius: float = np.inf  # Plan radius, m; positive turns left
    grade: float = 0.0  # Rise over run
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # Place of station 0 on the floor, m

    def place(self, local: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"]:
        """Return places given by station, left and up in the survey frame, m."""
        station, left, up = local.T
        turn = station / self.radius
        # Stable for a straight line, too: sin(x) / x and (1 - cos(x)) / x.
        forward = station * np.sinc(turn / np.pi)
        aside = station * np.sinc(turn / (2.0 * np.pi)) * np.sin(0.5 * turn)
        x, y = forward - left * np.sin(turn), aside + left * np.cos(turn)
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.stack([c * x - s * y, s * x + c * y, up + self.grade * station], axis=1) + self.offset


def draw_alignment(rng: np.random.Generator, radius: float | None = None) -> Alignment:
    """Draws heading, place, a grade within ±1 % and, if it is not given, a radius of 300 to 900 m to either side."""
    bend = rng.choice([-1.0, 1.0]) * (rng.uniform(300.0, 900.0) if radius is None else radius)
    offset = rng.uniform([1000.0, 1000.0, 10.0], [9000.0, 9000.0, 300.0])
    return Alignment(rng.uniform(-np.pi, np.pi), float(bend), rng.uniform(-0.01, 0.01), tuple(offset))


@dataclass(frozen=True)
class Surface:
    """Triangles of the air's surface, in straight coordinates and in the survey frame."""

    local: Float[np.ndarray, "v 3"]  # Station, left, up, m
    placed: Float[np.ndarray, "v 3"]  # In the survey frame, m
    faces: Float[np.ndarray, "f 3"]  # Corners of each triangle


def surface_of(air: Manifold, alignment: Alignment) -> Surface:
    """Return the surface of the air, bent along an alignment."""
    mesh: Mesh = air.refine_to_length(_FACET).to_mesh() if np.isfinite(alignment.radius) else air.to_mesh()
    local = np.asarray(mesh.vert_properties, float)[:, :3]
    return Surface(local, alignment.place(local), np.asarray(mesh.tri_verts, np.int32))
