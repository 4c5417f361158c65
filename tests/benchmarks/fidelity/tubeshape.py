"""The dimensions of the tube, and where they put its axis, its wall and its furniture."""

from dataclasses import dataclass

import numpy as np

from tests.benchmarks.fidelity.tubemesh import Section

ROWS = (-0.35, 0.35, np.pi - 0.35, np.pi + 0.35, 1.1, np.pi - 1.1)  # angles of the pockets' middles
POCKET = np.dtype([(name, float) for name in ("station", "angle", "length", "width", "depth", "confidence")]
                  + [("measured", bool)])  # fmt: skip


@dataclass(frozen=True)
class Tube:
    """A D-shaped bore, by default a left-hand bend; m, rad."""

    length: float = 18.0
    width: float = 5.6
    height: float = 6.2
    bend: float = 300.0  # Radius of the bend in plan; `inf` is straight
    # Of the first tangent; not a multiple of a right angle, so that nothing is aligned with the world
    heading: float = 0.3
    grade: float = 0.01
    variation: float = 0.006  # Relative change of width and height along the tube, a sine of 9 m
    shift: tuple[float, float] = (0.0, 0.0)  # The axis's offset to the left and upwards
    rings: float = 0.7  # Station of the first joint; pockets lie 0.22 m before and after each
    pitch: float = 1.5
    depth: float = 0.13  # Of the pockets, 0 for none
    track: bool = True
    first_sleeper: float = 0.3  # Station
    spacing: float = 0.6
    gauge: float = 1.435
    rise: float = 0.06  # Top of the sleepers above the floor
    origin: tuple[float, float, float] = (200.0, -100.0, 30.0)

    def frames(self, station) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Position, tangent, lateral and up at stations, tunnel frame."""
        s = np.atleast_1d(np.asarray(station, float))
        flat = s / np.hypot(1.0, self.grade)
        turn = self.heading + flat / self.bend
        across = flat / 2 / self.bend  # chord of the arc: exact, and fine for a straight tube too
        chord = flat * np.sinc(across / np.pi)
        position = np.column_stack([
            chord * np.cos(self.heading + across), chord * np.sin(self.heading + across), flat * self.grade
        ])  # fmt: skip
        tangent = np.column_stack([np.cos(turn), np.sin(turn), np.full(len(s), self.grade)])
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        lateral = np.column_stack([-np.sin(turn), np.cos(turn), np.zeros(len(s))])
        up = np.cross(tangent, lateral)
        return position + self.shift[0] * lateral + self.shift[1] * up, tangent, lateral, up

    def scale(self, station) -> np.ndarray:
        """Of the section at stations."""
        return 1.0 + self.variation * np.sin(2 * np.pi * np.asarray(station) / 9.0)

    def point(self, station, left, up) -> np.ndarray:
        """Points at stations, `left` and `up` from the axis."""
        position, _, lateral, upward = self.frames(station)
        return position + np.reshape(left, (-1, 1)) * lateral + np.reshape(up, (-1, 1)) * upward

    @property
    def section(self) -> Section:
        """The section at scale 1."""
        return Section(self.width, self.height)

    @property
    def joints(self) -> np.ndarray:
        """Stations of the ring joints."""
        return np.arange(self.rings, self.length - 0.4, self.pitch)

    @property
    def pockets(self) -> np.ndarray:
        """Pockets by station and row; `depth` along the normal of the wall."""
        if not self.depth:
            return np.empty(0, POCKET)
        rows = [(s + o, a % (2 * np.pi), 0.2, 0.18, self.depth, 1.0, True)
                for s in self.joints for o in (-0.22, 0.22) for a in ROWS]  # fmt: skip
        return np.array([row for row in rows if 0.15 < row[0] < self.length - 0.15], POCKET)

    @property
    def sleepers(self) -> np.ndarray:
        """Stations of the sleepers."""
        return np.arange(self.first_sleeper, self.length - 0.15, self.spacing) if self.track else np.empty(0)

    @property
    def floor(self):
        """Height of the floor about the axis as a function of station."""
        return lambda station: -0.5 * self.height * self.scale(station)
