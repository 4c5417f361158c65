"""The bore: the reconstructed solid as a centreline with a section at every station."""

import zipfile
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from scene.errors import RecordingError

_VERTICAL = np.array([0.0, 0.0, 1.0])
_BEND_OVER = 10.0  # m


@dataclass(frozen=True)
class Axis:
    """A centreline sampled at uniform stations."""

    station: Float[np.ndarray, " n"]  # Arc length, m
    position: Float[np.ndarray, "n 3"]  # m
    tangent: Float[np.ndarray, "n 3"]  # Unit vectors of growing station
    lateral: Float[np.ndarray, "n 3"]  # Unit vectors, horizontal, to the left
    up: Float[np.ndarray, "n 3"]  # Unit vectors, `tangent × lateral`

    @property
    def length(self) -> float:
        """Length from the first to the last station, m."""
        return float(self.station[-1] - self.station[0])

    @property
    def curvature(self) -> Float[np.ndarray, " n"]:
        """Turn of the heading for each metre in plan, 1/m, positive to the left; the reciprocal of the plan radius.

        Taken over 10 m, or what of them the axis has, so that it is the track's bend and not the fit's noise.
        """
        heading = np.unwrap(np.arctan2(self.tangent[:, 1], self.tangent[:, 0]))
        run = np.hypot(self.tangent[:, 0], self.tangent[:, 1])
        plan = np.concatenate([[0.0], np.cumsum((run[1:] + run[:-1]) / 2 * np.diff(self.station))])
        ends = [np.clip(plan + side * _BEND_OVER / 2, plan[0], plan[-1]) for side in (-1, 1)]
        before, after = (np.interp(end, plan, heading) for end in ends)
        return (after - before) / np.maximum(ends[1] - ends[0], 1e-9)

    @property
    def grade(self) -> Float[np.ndarray, " n"]:
        """Rise for each metre in plan."""
        return self.tangent[:, 2] / np.hypot(self.tangent[:, 0], self.tangent[:, 1])

    def at(self, station: Float[np.ndarray, " k"]) -> "Axis":
        """Return the axis at other stations; beyond its ends it runs on straight."""
        inside = np.clip(station, self.station[0], self.station[-1])
        spline = CubicSpline(self.station, self.position)
        position, tangent = spline(inside), spline(inside, 1)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        return make_axis(station, position + (station - inside)[:, None] * tangent, tangent)

    def reversed(self) -> "Axis":
        """Return the same curve run from the other end, stations from 0."""
        station = self.station[-1] - self.station[::-1]
        return make_axis(station, self.position[::-1], -self.tangent[::-1])

    def local(self, points: Float[np.ndarray, "p 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return station, lateral and upward offset of points from the nearest sample of the axis, m, `(p,)` each."""
        nearest = cKDTree(self.position).query(points, workers=-1)[1]
        offset = points - self.position[nearest]

        def along(directions: np.ndarray) -> np.ndarray:
            return np.einsum("ij,ij->i", offset, directions[nearest])

        return self.station[nearest] + along(self.tangent), along(self.lateral), along(self.up)


def make_axis(station: np.ndarray, position: np.ndarray, tangent: np.ndarray) -> Axis:
    """Return an axis with its lateral and up vectors; a tangent must not be vertical."""
    lateral = np.cross(_VERTICAL, tangent)
    lateral /= np.linalg.norm(lateral, axis=1, keepdims=True)
    return Axis(station, position, tangent, lateral, np.cross(tangent, lateral))


def axis_through(points: Float[np.ndarray, "n 3"], spacing: float) -> Axis:
    """Return the cubic spline through points in order, no two alike, m, resampled by arc length from 0.

    Stations are `spacing` m apart, or slightly less.
    """
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    spline = CubicSpline(chord, points)
    fine = np.linspace(0.0, chord[-1], 20 * len(points))
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(spline(fine), axis=0), axis=1))])
    station = np.linspace(0.0, arc[-1], int(np.ceil(arc[-1] / spacing - 1e-9)) + 1)
    at = np.interp(station, arc, fine)
    tangent = spline(at, 1)
    return make_axis(station, spline(at), tangent / np.linalg.norm(tangent, axis=1, keepdims=True))


SCHEMA = "subterra.bore/1"
STATION_STEP = 0.25

_PATCH = [(name, "f8") for name in ("station", "angle", "length", "width", "depth", "confidence")]
POCKET = np.dtype([*_PATCH, ("measured", "?")])
_BOLT = [(name, "f8") for name in ("station", "angle", "length", "diameter", "depth", "confidence")]
NAIL = np.dtype([*_BOLT, ("measured", "?")])
_SIZES = [(name, "f8") for name in ("width", "height", "crown_radius", "wall_radius", "rms", "rms_free", "confidence")]
STRETCH = np.dtype([("start", "f8"), ("end", "f8"), ("type", "U9"), *_SIZES])


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
    coverage: Float[np.ndarray, " n"]  # Share of the section's angles seen
    filled: Bool[np.ndarray, " n"]  # Section interpolated
    ring_station: Float[np.ndarray, " r"]  # Ring joints, m
    pocket: Shaped[np.ndarray, " p"]  # Recesses of the lining, `(p,)` of `POCKET`
    # Probability that the wall is within 5 cm of the true one, mean over the angles
    confidence: Float[np.ndarray, " n"]
    # Stretches of one type of section, `(t,)` of `STRETCH`
    stretch: Shaped[np.ndarray, " t"] = field(default_factory=lambda: np.empty(0, STRETCH))
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
        """The centreline alone."""
        return make_axis(self.station, self.position, self.tangent)

    def surface(self) -> Float[np.ndarray, "n m 3"]:
        """Return the points of the smooth wall in the tunnel frame, m."""
        across, along = self.radius * np.cos(self.angle), self.radius * np.sin(self.angle)
        return self.position[:, None] + across[..., None] * self.lateral[:, None] + along[..., None] * self.up[:, None]

    @property
    def section_type(self) -> Shaped[np.ndarray, " n"]:
        """Type of section at each station: `d`, `horseshoe`, `circle` or `free`, `(n,)`."""
        types = np.full(len(self.station), "free", STRETCH["type"])
        for stretch in self.stretch:
            types[(self.station >= stretch["start"]) & (self.station <= stretch["end"])] = stretch["type"]
        return types

    def save(self, path: Path) -> None:
        """Writes `bore.npz`, with what follows from the axis and the stretches; the same bore gives the same bytes."""
        axis = self.axis
        derived: dict[str, Any] = {"curvature": axis.curvature, "grade": axis.grade, "section_type": self.section_type}
        own: dict[str, Any] = {part.name: getattr(self, part.name) for part in fields(self)}
        np.savez_compressed(path, schema=SCHEMA, **own, **derived)


def load_bore(path: Path) -> Bore:
    """Reads `bore.npz`; raises `RecordingError` for any other file and for another schema."""
    try:
        with np.load(path) as data:
            if str(data["schema"]) != SCHEMA:
                raise RecordingError(
                    f"{path}: schema is {data['schema']}, not {SCHEMA}, so another version of Subterra wrote it; "
                    "build the scene again with `python -m scene.build`"
                )
            values = {part.name: data[part.name] for part in fields(Bore) if part.name in data}
            values.setdefault("confidence", np.full(len(values["station"]), np.nan))  # not in the first files
            return Bore(**values)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise RecordingError(f"{path}: not a bore file ({error})") from error


def uniform_stations(length: float) -> Float[np.ndarray, " n"]:
    """Return stations from 0 to `length`, at most `STATION_STEP` apart, m."""
    return np.linspace(0.0, length, int(np.ceil(length / STATION_STEP - 1e-9)) + 1)
