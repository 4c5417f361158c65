"""The bore: the reconstructed solid as a centreline with a section at every station."""

import zipfile
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Shaped

from scene.axis import Axis, with_frames
from scene.errors import RecordingError

SCHEMA = "subterra.bore/1"
STATION_STEP = 0.25

POCKET = np.dtype(
    [
        ("station", "f8"),
        ("angle", "f8"),
        ("length", "f8"),
        ("width", "f8"),
        ("depth", "f8"),
        ("confidence", "f8"),
        ("measured", "?"),
    ]
)

NAIL = np.dtype(
    [
        ("station", "f8"),
        ("angle", "f8"),
        ("length", "f8"),
        ("diameter", "f8"),
        ("depth", "f8"),
        ("confidence", "f8"),
        ("measured", "?"),
    ]
)

STRETCH = np.dtype(
    [
        ("start", "f8"),
        ("end", "f8"),
        ("type", "U9"),
        ("width", "f8"),
        ("height", "f8"),
        ("crown_radius", "f8"),
        ("wall_radius", "f8"),
        ("rms", "f8"),
        ("rms_free", "f8"),
        ("confidence", "f8"),
    ]
)


@dataclass(frozen=True)
class Bore:
    """The arrays of `bore.npz`; docs/formats.md says what each means.

    Attributes:
        station: m, from 0, uniform, `(n,)`.
        position: Centreline, m, `(n, 3)`.
        tangent: Unit vectors, `(n, 3)`.
        lateral: Unit vectors to the left, `(n, 3)`.
        up: Unit vectors, `(n, 3)`.
        width: Largest inner width, m, `(n,)`.
        height: Floor to crown on the axis, m, `(n,)`.
        angle: From `lateral` towards `up`, rad, `(m,)`.
        radius: Smooth section about the centreline, m, `(n, m)`.
        residual_rms: Of the section's inliers, m, `(n,)`.
        coverage: Share of the section's angles seen, `(n,)`.
        filled: Section interpolated, `(n,)`.
        ring_station: Ring joints, m, `(r,)`.
        pocket: Recesses of the lining, `(p,)` of `POCKET`.
        confidence: Probability that the wall is within 5 cm of the true one, mean over the angles, `(n,)`.
        stretch: Stretches of one type of section, `(t,)` of `STRETCH`.
        nail: Bolts that bridge two pockets across a joint, `(b,)` of `NAIL`.
    """

    station: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "n 3"]
    tangent: Float[np.ndarray, "n 3"]
    lateral: Float[np.ndarray, "n 3"]
    up: Float[np.ndarray, "n 3"]
    width: Float[np.ndarray, " n"]
    height: Float[np.ndarray, " n"]
    angle: Float[np.ndarray, " m"]
    radius: Float[np.ndarray, "n m"]
    residual_rms: Float[np.ndarray, " n"]
    coverage: Float[np.ndarray, " n"]
    filled: Bool[np.ndarray, " n"]
    ring_station: Float[np.ndarray, " r"]
    pocket: Shaped[np.ndarray, " p"]
    confidence: Float[np.ndarray, " n"]
    stretch: Shaped[np.ndarray, " t"] = field(default_factory=lambda: np.empty(0, STRETCH))
    nail: Shaped[np.ndarray, " b"] = field(default_factory=lambda: np.empty(0, NAIL))

    @property
    def length(self) -> float:
        """Of the centreline, m."""
        return float(self.station[-1])

    @property
    def axis(self) -> Axis:
        """The centreline alone."""
        return with_frames(self.station, self.position, self.tangent)

    def surface(self) -> Float[np.ndarray, "n m 3"]:
        """Points of the smooth wall in the tunnel frame, m."""
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


def load(path: Path) -> Bore:
    """Reads `bore.npz`.

    Raises:
        RecordingError: Not such a file, or of another schema.
    """
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
    """From 0 to `length`, at most `STATION_STEP` apart, m."""
    return np.linspace(0.0, length, int(np.ceil(length / STATION_STEP - 1e-9)) + 1)
