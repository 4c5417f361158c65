"""The bore: the reconstructed solid as a centreline with a section at every station."""

from dataclasses import dataclass, fields
from pathlib import Path

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

    def save(self, path: Path) -> None:
        """Writes `bore.npz`; the same bore gives the same bytes."""
        np.savez_compressed(path, schema=SCHEMA, **{field.name: getattr(self, field.name) for field in fields(self)})


def load(path: Path) -> Bore:
    """Reads `bore.npz`.

    Raises:
        RecordingError: Not such a file, or of another schema.
    """
    try:
        with np.load(path) as data:
            if str(data["schema"]) != SCHEMA:
                raise RecordingError(f"{path}: schema is {data['schema']}, not {SCHEMA}")
            return Bore(**{field.name: data[field.name] for field in fields(Bore)})
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise RecordingError(f"{path}: not a bore file ({error})") from error


def uniform_stations(length: float) -> Float[np.ndarray, " n"]:
    """From 0 to `length`, at most `STATION_STEP` apart, m."""
    return np.linspace(0.0, length, int(np.ceil(length / STATION_STEP - 1e-9)) + 1)
