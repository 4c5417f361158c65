"""The planar tunnel on the host: the content of its file as float64 NumPy, with every lining variant."""

from __future__ import annotations

import dataclasses

import numpy as np

from subterra_jax.host.errors import TunnelError
from subterra_jax.tunnel.shell import Shell


@dataclasses.dataclass(frozen=True)
class Wall:
    """One wall as an open polyline in the direction of growing station.

    Attributes:
        vertex: Vertices in the tunnel frame, m, `(k, 2)`.
        station: Station of each vertex, m, `(k,)`, not decreasing.
    """

    vertex: np.ndarray
    station: np.ndarray


@dataclasses.dataclass(frozen=True)
class Lining:
    """One variant of the walls.

    Attributes:
        left: The wall on the left of growing station.
        right: The wall on the right.
        furniture: Further wall segments `x0, y0, x1, y1`, m, `(f, 4)`; may be empty.
    """

    left: Wall
    right: Wall
    furniture: np.ndarray

    @property
    def segments(self) -> np.ndarray:
        """Every wall segment as `x0, y0, x1, y1`, m, `(n, 4)`: the reference for LiDAR ranges."""
        chains = [np.hstack([wall.vertex[:-1], wall.vertex[1:]]) for wall in (self.left, self.right)]
        return np.concatenate([*chains, self.furniture])


@dataclasses.dataclass(frozen=True)
class TunnelPlan:
    """A tunnel file in memory.

    Attributes:
        name: Name of the tunnel.
        provenance: `measured` or `simulated`.
        station: Uniform stations from 0 to the length, m, `(n,)`.
        centre: Centreline, m, `(n, 2)`.
        tangent: Unit tangent of the centreline, `(n, 2)`.
        elevation: Height of the ground the robot drives on, m, `(n,)`.
        half_width: Half the distance between the smooth walls, m, `(n,)`.
        lidar_height: Height of the LiDAR plane above `elevation`, m.
        linings: Variant name to its walls.
        ring_pitch: Distance between ring joints by the drawings, which agents are given, m; 0 without rings, or if
            unknown. Pockets repeat with it.
        shell: The bore in three dimensions; `None` where it is not known.
        source: File that it was read from; empty if from none.
        texture: Seed of the brightness of its walls; `None` where it is not known.
    """

    name: str
    provenance: str
    station: np.ndarray
    centre: np.ndarray
    tangent: np.ndarray
    elevation: np.ndarray
    half_width: np.ndarray
    lidar_height: float
    linings: dict[str, Lining]
    ring_pitch: float = 0.0
    shell: Shell | None = None
    source: str = ""
    texture: int | None = None

    @property
    def length(self) -> float:
        """Length of the centreline, m."""
        return float(self.station[-1])

    @property
    def default_lining(self) -> str:
        """Variant used by default: `pockets`, or the first if there is none of that name."""
        return "pockets" if "pockets" in self.linings else next(iter(self.linings))

    def lining(self, name: str) -> Lining:
        """Return the walls of one variant; raises `TunnelError` with the known names for an unknown one."""
        if name not in self.linings:
            raise TunnelError(f"tunnel {self.name!r} has no lining {name!r}; it has {', '.join(self.linings)}")
        return self.linings[name]

    def slice(self, start: float, length: float) -> TunnelPlan:
        """Return the stretch from `start` to `start + length`, with stations from 0 and both mouths open.

        Args:
            start: Station at which the stretch begins, m.
            length: Length of the stretch, m; the station grid keeps its spacing as nearly as a uniform grid allows.

        Raises:
            ValueError: The stretch does not lie within the tunnel.
        """
        end = start + length
        if not (0.0 <= start < end <= self.length + 1e-9):
            raise ValueError(f"slice {start}..{end} m does not lie within the tunnel's 0..{self.length} m")
        spacing = self.station[1] - self.station[0]
        station = np.linspace(start, end, max(2, round(length / spacing) + 1))

        def along(values: np.ndarray) -> np.ndarray:
            columns = values.reshape(len(values), -1).T
            return np.stack([np.interp(station, self.station, c) for c in columns], axis=-1).reshape(
                len(station), *values.shape[1:]
            )

        tangent = along(self.tangent)
        return dataclasses.replace(
            self,
            station=station - start,
            centre=along(self.centre),
            tangent=tangent / np.linalg.norm(tangent, axis=1, keepdims=True),
            elevation=along(self.elevation),
            half_width=along(self.half_width),
            linings={
                name: Lining(
                    _cut(lining.left, start, end), _cut(lining.right, start, end), self._furniture(lining, start, end)
                )
                for name, lining in self.linings.items()
            },
            shell=None if self.shell is None else self.shell.cut(start, end),
        )

    def stretch(self, wanted: tuple[float, float] | None) -> TunnelPlan:
        """Return the stretch from a start and of a length at most, m; for None the whole."""
        return self if wanted is None else self.slice(wanted[0], min(wanted[1], self.length - wanted[0]))

    def _furniture(self, lining: Lining, start: float, end: float) -> np.ndarray:
        """Return the furniture whose middle lies between two stations."""
        middle = 0.5 * (lining.furniture[:, :2] + lining.furniture[:, 2:])
        nearest = np.array([np.argmin(np.sum((self.centre - m) ** 2, axis=1)) for m in middle], dtype=int)
        station = self.station[nearest]
        return lining.furniture[(station >= start) & (station <= end)]


def _cut(wall: Wall, start: float, end: float) -> Wall:
    """Return the part of a wall between two stations, with new vertices at the cuts."""
    keep = (wall.station > start) & (wall.station < end)
    # A cut through the end of a wall must not invent a vertex beyond it.
    ends = np.clip([start, end], wall.station[0], wall.station[-1])
    cut = np.stack([np.interp(ends, wall.station, wall.vertex[:, i]) for i in range(2)], axis=-1)
    return Wall(
        vertex=np.concatenate([cut[:1], wall.vertex[keep], cut[1:]]),
        station=np.concatenate([ends[:1], wall.station[keep], ends[1:]]) - start,
    )
