"""Settings of a build, and the refusal of those that no build can have."""

import math
from dataclasses import dataclass, field, fields, is_dataclass
from datetime import date
from typing import Any

from scene.cleaning.clean import ExtentConfig
from scene.fitting.axis import CentrelineConfig
from scene.fitting.lining import LiningConfig
from scene.judging.judge import JudgingConfig
from scene.reading.formats import ReadingConfig
from scene.writing.mjcf import SceneConfig
from scene.writing.track import TrackConfig
from subterra_jax.host.errors import SubterraError


@dataclass(frozen=True)
class ReconstructConfig:
    """Settings of the steps from an input to a bore."""

    voxel: float = 0.04  # Thinning of the cloud, m.
    reading: ReadingConfig = field(default_factory=ReadingConfig)  # What the user says instead of having it detected.
    extent: ExtentConfig = field(default_factory=ExtentConfig)  # Part that is built, and how its stations count.
    centreline: CentrelineConfig = field(default_factory=CentrelineConfig)  # Search for the axis.
    lining: LiningConfig = field(default_factory=LiningConfig)  # Lining by standard, where the survey can show none.


@dataclass(frozen=True)
class BuildConfig:
    """Everything a build depends on beside its input."""

    name: str = ""  # Name of the tunnel; that of the output folder where not given.
    date: str = ""  # Day that the manifest states; none: same input, same bytes on one machine.
    provenance: str = "measured"  # Kind of recording, such as `simulated` for a simulated survey.
    reconstruct: ReconstructConfig = field(default_factory=ReconstructConfig)  # Steps from the input to a bore.
    track: TrackConfig = field(default_factory=TrackConfig)  # Standard by which the track is laid.
    scene: SceneConfig = field(default_factory=SceneConfig)  # Cutting and dressing of the scene.
    judging: JudgingConfig = field(default_factory=JudgingConfig)  # Limits of what a bore may leave unexplained.


class SettingError(SubterraError):
    """A setting that no build can have."""


_LONGEST_NAME = 100  # characters
_VOXELS = (0.001, 1.0)  # m: finer than a LiDAR measures, coarser than any wall shows
_POSITIVE = ("spacing", "voxel", "cutoff", "gauge", "length", "width", "height", "diameter", "size",
             "sigma", "per-scan", "max", "block")  # fmt: skip


def check_settings(config: Any, prefix: str = "") -> None:
    """Refuses numbers that are negative or not finite in a tree of dataclasses; some may not be 0 either.

    `prefix` stands before the options' names. Raises `SettingError`, which names the option and its value.
    """
    for part in fields(config):
        value, name = getattr(config, part.name), f"{prefix}{part.name.replace('_', '-')}"
        if is_dataclass(value):
            check_settings(value, f"{name}.")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, (int, float)) and not isinstance(number, bool):
                check_number(name, number)


def check_words(name: str, day: str) -> None:
    """Refuses a name that is no file's, and a day that is none; each may be empty. Raises `SettingError`."""
    if len(name) > _LONGEST_NAME or not name.isprintable() or set(name) & set("/\\"):
        why = f"must be at most {_LONGEST_NAME} characters of one line without / and \\"
        raise SettingError(f"--name {why}, got {name[:_LONGEST_NAME]!r}")
    try:
        date.fromisoformat(day or "2026-01-01")
    except ValueError:
        raise SettingError(f"--date must be a day such as 2026-01-31, got {day!r}") from None


def check_number(name: str, value: float) -> None:
    """Refuses a number out of its range; `name` tells the range. Raises `SettingError`."""
    if not math.isfinite(value):
        raise SettingError(f"--{name} must be a finite number, got {value}")
    if value < 0.0:
        raise SettingError(f"--{name} must not be negative, got {value:g}")
    if value == 0.0 and name.endswith(_POSITIVE):
        raise SettingError(f"--{name} must be above 0, got {value:g}")
    if name.endswith("voxel") and not _VOXELS[0] <= value <= _VOXELS[1]:
        raise SettingError(f"--{name} must lie between {_VOXELS[0]:g} and {_VOXELS[1]:g} m, got {value:g}")
