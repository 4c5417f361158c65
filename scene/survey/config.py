"""What one simulated survey is asked to be."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class SurveyConfig:
    """Simulate the survey of one bore and write it with its truth."""

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder to write to; made if missing."""
    length: float = 60.0
    """Length of the bore along its centreline, m."""
    seed: int = 0
    """Draws the bore, the walk and all noise. The same seed gives the same bytes."""
    speed: float = 1.0
    """Mean walking speed, m/s."""
    point_rate: int = 240_000
    """LiDAR points per second; less than the Avia's own 240,000 thins the survey."""
    cloud: bool = False
    """Also write `cloud.ply` and `cloud.pcd`, the returns placed by the true poses."""


def check(config: SurveyConfig) -> None:
    """Refuse what cannot be simulated.

    Raises:
        ValueError: A field is out of range, or `out` is a file.
    """
    if not 10.0 < config.length <= 2000.0:
        raise ValueError(f"length must be more than 10 m and at most 2000 m, got {config.length:g}")
    if not 0.1 <= config.speed <= 10.0:
        raise ValueError(f"speed must lie between 0.1 and 10 m/s, got {config.speed:g}")
    if config.seed < 0:
        raise ValueError(f"seed must not be negative, got {config.seed}")
    if not 60 <= config.point_rate <= 240_000 or config.point_rate % 60:
        raise ValueError(f"point_rate must be a multiple of 60 between 60 and 240000, got {config.point_rate}")
    # The nearest existing parent decides whether the folder can be made.
    for folder in (config.out, *config.out.parents):
        if folder.exists():
            if not folder.is_dir():
                raise ValueError(f"out must be a folder, but {folder} is a file")
            return
