"""A recorded episode in one `.npz`, with everything needed to show it again."""

import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from subterra_jax.host.files import replace_file
from subterra_jax.host.versions import other_schema
from subterra_jax.tunnel.file import describe_damage
from subterra_jax.viewer.config import ViewerError

SCHEMA = "subterra.episode/1"
N_POSE = 16  # a quaternion and twelve joints
_TEXTS = ("task", "agent", "tunnel", "tunnel_sha256", "lining")
_NUMBERS = ("seed", "period", "radius", "range_max", "length", "start", "goal", "success", "contact")
_SHAPES: dict[str, tuple[str | int, ...]] = {
    "position": ("t", 2),
    "heading": ("t",),
    "station": ("t",),
    "odometry": ("t", 2),
    "ranges": ("t", "n_beams"),
    "command": ("t", 2),
    "estimate": ("t", 2),
    "reward": ("t",),
    "coverage": ("t",),
    "cloud": ("t", "k", 3),
    "boxes": ("b", 6),
    "trunk": ("t",),
    "pose": ("t", "m", N_POSE),
    "points": ("t", "p", 3),
}


class EpisodeFileError(ViewerError):
    """A recorded episode cannot be read, or there is none to save."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """An episode so far. Row 0 of a series is the start, row t comes after step t."""

    task: str  # id of the task
    agent: str  # name of the driver
    tunnel: str  # name of the tunnel in the viewer's list
    tunnel_sha256: str  # digest of the tunnel, from `tunnel_digest`
    lining: str  # variant of the walls
    seed: float  # seed of the episode
    period: float  # control period, s
    radius: float  # radius of the robot, m
    range_max: float  # range of a beam that hits nothing, m
    length: float  # length of the driven piece of tunnel, m
    start: float  # station at which the robot believes to start, m
    goal: float  # station of the goal, m; NaN without a goal
    success: float  # 1 if the task was achieved, else 0
    contact: float  # 1 if the episode ended at a wall or an obstacle, else 0
    position: Float[np.ndarray, "t 2"]  # true position, tunnel frame, m
    heading: Float[np.ndarray, "t"]  # true heading, rad
    station: Float[np.ndarray, "t"]  # true station, m
    odometry: Float[np.ndarray, "t 2"]  # dead-reckoned distance (m) and heading (rad) as observed
    ranges: Float[np.ndarray, "t n_beams"]  # LiDAR ranges as observed, m
    command: Float[np.ndarray, "t 2"]  # speed (m/s) and yaw rate (rad/s) that led here; 0 in row 0
    # estimated station and its standard deviation, m; NaN without an estimate, and in row 0
    estimate: Float[np.ndarray, "t 2"]
    reward: Float[np.ndarray, "t"]  # reward of the step that led here
    coverage: Float[np.ndarray, "t"]  # share of the tunnel covered
    # some of the agent's particles: station and lateral offset, m, and weight over the mean weight; `k` is 0 without a
    # particle filter
    cloud: Float[np.ndarray, "t k 3"]
    boxes: Float[np.ndarray, "b 6"]  # obstacles: middle x, y (m), unit vector along the first side, half sides (m)
    trunk: Float[np.ndarray, "t"]  # height of a walking robot's trunk, tunnel frame, m; 0 for wheeled robots
    # orientation w, x, y, z and joints (rad) of a walking robot at even times up to this row, the last at the row
    # itself; `m` is 0 for wheeled robots
    pose: Float[np.ndarray, "t m 16"]
    # Returns of a LiDAR in three dimensions in the robot's frame on the ground, m, some of them where it has many
    # beams; NaN without a return. `p` is 0 for a planar LiDAR.
    points: Float[np.ndarray, "t p 3"]

    def __len__(self) -> int:
        return len(self.station)

    @property
    def duration(self) -> float:
        """Time from the first row to the last, s."""
        return round((len(self) - 1) * self.period, 3)

    @property
    def file_name(self) -> str:
        """Name of its file; the same episode always has the same name."""
        parts = (self.task.split("/")[-1], self.agent, Path(self.tunnel).stem, self.lining, str(int(self.seed)))
        plain = ("".join(c if c.isalnum() or c in "-." else "-" for c in part) for part in parts)
        return "_".join(plain) + ".npz"

    def extend(self, rows: dict[str, Any], success: float, contact: float) -> "Recording":
        series: dict[str, Any] = {name: np.concatenate([getattr(self, name), values]) for name, values in rows.items()}
        return dataclasses.replace(self, success=success, contact=contact, **series)


def save(recording: Recording, path: Path) -> None:
    """Write an episode, under a temporary name first; the same episode gives the same bytes.

    Raises:
        OutputError: The file cannot be written.
    """
    buffer = io.BytesIO()
    np.savez_compressed(buffer, schema=np.array(SCHEMA), **vars(recording))
    with replace_file(path) as partial:
        partial.write_bytes(buffer.getvalue())


def load(path: Path) -> Recording:
    """Read an episode.

    Raises:
        EpisodeFileError: The file is missing or is no recording, or a field is missing or has the wrong shape.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            fields = {name: data[name] for name in data.files}
    except FileNotFoundError as error:
        raise EpisodeFileError(f"{path}: no such recording") from error
    except Exception as error:  # zipfile, zlib and NumPy each raise their own for a damaged archive
        raise EpisodeFileError(f"{path}: not a readable recording ({describe_damage(path, error)})") from error
    schema = str(fields["schema"]) if "schema" in fields else None
    if schema != SCHEMA:
        raise EpisodeFileError(f"{path}: {other_schema(schema, SCHEMA, 'save the episode again in the viewer')}")
    texts: dict[str, Any] = {name: str(_field(path, fields, name, (), "U")) for name in _TEXTS}
    numbers: dict[str, Any] = {name: float(_field(path, fields, name, (), "fiub")) for name in _NUMBERS}
    series: dict[str, Any] = {name: _field(path, fields, name, shape, "f") for name, shape in _SHAPES.items()}
    _check_values(path, series, numbers["period"])
    return Recording(**texts, **numbers, **series)


def _check_values(path: Path, series: dict[str, Any], period: float) -> None:
    """Refuse series of unlike length or that are not finite, and a period that is none."""
    sizes = {len(values) for name, values in series.items() if name != "boxes"}
    if len(sizes) != 1 or 0 in sizes:
        raise EpisodeFileError(f"{path}: its series must have one length of at least 1, have {sorted(sizes)}")
    for name in ("position", "heading", "station", "odometry", "reward", "coverage"):
        if not np.isfinite(series[name]).all():
            raise EpisodeFileError(f"{path}: field {name!r} has a value that is not finite")
    if not (np.isfinite(period) and period > 0.0):
        raise EpisodeFileError(f"{path}: field 'period' must be positive, is {period}")


def _field(path: Path, fields: dict[str, Any], name: str, shape: tuple[str | int, ...], kinds: str) -> Any:
    if name not in fields:
        raise EpisodeFileError(f"{path}: field {name!r} is missing")
    value = fields[name]
    fits = value.ndim == len(shape) and all(
        isinstance(want, str) or want == have for want, have in zip(shape, value.shape, strict=True)
    )
    if value.dtype.kind not in kinds or not fits:
        raise EpisodeFileError(f"{path}: field {name!r} must have shape {shape}, is {value.dtype} of {value.shape}")
    return value
