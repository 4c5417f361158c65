"""What to record, and whether it can be had."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from subterra_jax.host.errors import SubterraError
from subterra_jax.host.files import require_folder
from subterra_jax.lidar3d import beams

CloudName = Literal["none", "vlp16", "os1"]
_BEAMS: dict[str, tuple[Callable[[int], np.ndarray], int]] = {"vlp16": (beams.vlp16, 16), "os1": (beams.os1, 64)}


class RecordingError(SubterraError):
    """A recording that cannot be made as it was asked for."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """One episode to record.

    Attributes:
        out: Folder to make; `recording/` and `truth/` go into it.
        task: Task id, as `Subterra/StopAt-v0` or `StopAt`.
        agent: Who drives, by its name on the leaderboard.
        policy: A policy drives instead: a `.safetensors` file or the name of a released one.
        seed: Of everything random in the episode.
        episode: Record this one of the task's 500 listed episodes instead (from 0), as the leaderboard drives it.
        tunnel: Tunnel file or name; the packaged tunnel if left out.
        lining: Variant of the walls; `pockets` if left out.
        scene: Built scene folder: its tunnel is driven, and clouds are taken in it.
        cloud: LiDAR in three dimensions, which needs `scene`.
        columns: Columns in a turn of that LiDAR.
        every: Steps from one cloud to the next.
        beams: Beams of a further planar scan in `/scan_dense`; none if 0.
        imu: Record an IMU at 100 Hz.
        steps: Steps after which the recording ends if the episode has not; the task's horizon if left out.
        truth: Folder for the truth, if it is to lie elsewhere.
    """

    out: Path
    task: str = "Subterra/StopAt-v0"
    agent: str = "dead-reckoning"
    policy: str | None = None
    seed: int = 0
    episode: int | None = None
    tunnel: str | None = None
    lining: str | None = None
    scene: Path | None = None
    cloud: CloudName = "none"
    columns: int = 900
    every: int = 1
    beams: int = 0
    imu: bool = False
    steps: int | None = None
    truth: Path | None = None

    @property
    def recording_folder(self) -> Path:
        """Where the sensors' part goes."""
        return self.out / "recording"

    @property
    def truth_folder(self) -> Path:
        """Where the truth goes."""
        return self.truth or self.out / "truth"

    @functools.cached_property
    def directions(self) -> Float[np.ndarray, "n 3"]:
        """Beams of the LiDAR in three dimensions, unit vectors in its frame, column by column."""
        make, _ = _BEAMS[self.cloud]
        return make(self.columns)

    @property
    def n_rings(self) -> int:
        """Rings of the LiDAR in three dimensions."""
        return _BEAMS[self.cloud][1]


def checked(config: Recording) -> Recording:
    """The config itself, once its numbers are known to make sense and its folders to be free.

    Raises:
        RecordingError: They are not; says which and why.
        OutputError: A folder cannot be written.
    """
    least = {"columns": 8, "every": 1, "beams": 0, "seed": 0}
    if config.steps is not None:
        least["steps"] = 1
    if config.episode is not None:
        least["episode"] = 0
    for name, value in least.items():
        if getattr(config, name) < value:
            raise RecordingError(f"{name} must be at least {value}, got {getattr(config, name)}")
    if config.seed >= 2**32:
        raise RecordingError(f"seed must be below 2**32, got {config.seed}")
    if config.cloud not in ("none", *_BEAMS):
        raise RecordingError(f"no LiDAR {config.cloud!r}; there are {', '.join(_BEAMS)}")
    if config.cloud != "none" and config.scene is None:
        raise RecordingError(f"cloud {config.cloud!r} needs a scene folder (`python -m scene.build` makes one)")
    if config.scene is not None and config.tunnel is not None:
        raise RecordingError("either scene or tunnel, not both: a scene brings its own tunnel")
    for folder in (config.recording_folder, config.truth_folder):
        if folder.exists():
            raise RecordingError(f"{folder}: exists already; recordings are not overwritten")
        require_folder(folder)
    return config
