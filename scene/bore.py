"""The bore: the reconstructed solid as a centreline with a section at every station."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from scene.geometry import Axis, make_axis
from subterra_jax.host.unrolled import Sections, Unrolled, unroll

SCHEMA = "subterra.bore/1"
STATION_STEP = 0.25
_STRAIGHT = 1e-5  # 1/m

_PATCH = [(name, "f8") for name in ("station", "angle", "length", "width", "depth", "confidence")]
POCKET = np.dtype([*_PATCH, ("measured", "?")])
_BOLT = [(name, "f8") for name in ("station", "angle", "length", "diameter", "depth", "confidence")]
NAIL = np.dtype([*_BOLT, ("measured", "?")])


@dataclass(frozen=True)
class Bore:
    """The arrays of `bore.npz`; see docs/formats.md."""

    station: Float[np.ndarray, " n"]  # m, from 0, uniform
    position: Float[np.ndarray, "n 3"]  # Centreline, m
    tangent: Float[np.ndarray, "n 3"]  # Unit vectors
    lateral: Float[np.ndarray, "n 3"]  # Unit vectors to the left
    up: Float[np.ndarray, "n 3"]  # Unit vectors
    width: Float[np.ndarray, " n"]  # Largest inner width, m
    height: Float[np.ndarray, " n"]  # Floor to crown on the axis, m
    angle: Float[np.ndarray, " m"]  # Direction from `lateral` towards `up`, rad
    radius: Float[np.ndarray, "n m"]  # Smooth section about the centreline, m
    residual_rms: Float[np.ndarray, " n"]  # RMS distance of the section's inliers, m
    coverage: Float[np.ndarray, " n"]  # Fraction of the section's angles seen
    filled: Bool[np.ndarray, " n"]  # Section interpolated
    ring_station: Float[np.ndarray, " r"]  # Ring joints, m
    pocket: Shaped[np.ndarray, " p"]  # Recesses of the lining, `(p,)` of `POCKET`
    # Bolts that bridge two pockets across a joint, `(b,)` of `NAIL`
    nail: Shaped[np.ndarray, " b"] = field(default_factory=lambda: np.empty(0, NAIL))
    # Ring joints by standard, where `ring_station` has the surveyed rings, m; else empty
    ring_joint: Float[np.ndarray, " j"] = field(default_factory=lambda: np.empty(0))

    @property
    def length(self) -> float:
        """Length of the centreline, m."""
        return float(self.station[-1])

    @property
    def axis(self) -> Axis:
        return make_axis(self.station, self.position, self.tangent)

    def row_of(self, station: Float[np.ndarray, "..."] | float) -> Int[np.ndarray, "..."]:
        """Return the row of the section that is nearest to each station, m."""
        return np.clip(np.rint(station / self.station[1]), 0, len(self.station) - 1).astype(np.intp)

    def toward(self, angle: float) -> Float[np.ndarray, " n"]:
        """Return the distance from the axis to the wall in a direction, rad, at each station, m."""
        return np.array([np.interp(angle, self.angle, radius, period=2 * np.pi) for radius in self.radius])

    def surface(self) -> Float[np.ndarray, "n m 3"]:
        """Return the points of the smooth wall in the tunnel frame, m."""
        across, along = self.radius * np.cos(self.angle), self.radius * np.sin(self.angle)
        return self.position[:, None] + across[..., None] * self.lateral[:, None] + along[..., None] * self.up[:, None]

    @property
    def wall(self) -> Sections:
        """Smooth wall, by which meshes and casts go."""
        return Sections(self.station, self.position, self.tangent, self.lateral, self.up, self.angle, self.radius)

    @property
    def recesses(self) -> Float[np.ndarray, "p 5"]:
        """Station, m, angle, rad, length, width and depth, m, of each pocket."""
        return np.column_stack([self.pocket[name] for name in ("station", "angle", "length", "width", "depth")])

    def recess_boxes(self, pocket: Int[np.ndarray, " r"]) -> Float[np.ndarray, "r 8 3"]:
        """Return corners of some pockets as boxes square to the wall they are sunk into, m."""
        chosen = self.recesses[pocket]
        return self.wall.recess_boxes(chosen, self.axis.at(chosen[:, 0]).tangent)

    def unrolled(self) -> Unrolled:
        """Return the mean section's arc length; the seam is in the widest gap between recesses, else at the floor."""
        taken = np.sort(self.pocket["angle"] % (2 * np.pi))
        gap = np.diff(np.append(taken, taken[0] + 2 * np.pi)) if len(taken) else np.empty(0)
        seam = taken[np.argmax(gap)] + gap.max() / 2 if len(taken) else 1.5 * np.pi
        return unroll(self.angle, self.radius.mean(axis=0), seam)

    def find_fold(self) -> float | None:
        """Return the first station at which a section cuts the next one, m; `None` where none does."""
        step = np.einsum("nmi,ni->nm", np.diff(self.surface(), axis=0), self.tangent[:-1] + self.tangent[1:])
        folded = np.flatnonzero((step <= 0).any(axis=1))
        return float(self.station[folded[0]]) if len(folded) else None

    def describe(self) -> dict[str, Any]:
        """Return residual, coverage and alignment for the manifest; a straight bore has no plan radius."""
        axis = self.axis
        bend = float(np.abs(axis.curvature).max())
        return {
            "residual_rms": float(np.sqrt(np.mean(self.residual_rms**2))),
            "coverage": float(self.coverage.mean()),
            "least_plan_radius": 1 / bend if bend > _STRAIGHT else None,
            "grade": [float(axis.grade.min()), float(axis.grade.max())],
        }

    def save(self, path: Path) -> None:
        """Writes `bore.npz`, with curvature and grade of the axis; the same bore gives the same bytes."""
        own: dict[str, Any] = {part.name: getattr(self, part.name) for part in fields(self)}
        np.savez_compressed(path, schema=SCHEMA, **own, curvature=self.axis.curvature, grade=self.axis.grade)


def uniform_stations(length: float) -> Float[np.ndarray, " n"]:
    """Return stations from 0 to `length`, at most `STATION_STEP` apart, m."""
    return np.linspace(0.0, length, int(np.ceil(length / STATION_STEP - 1e-9)) + 1)
