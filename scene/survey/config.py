"""Settings of one simulated survey."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from scene.survey.messages import Convention
from subterra_jax.host.texture import check_dial

LidarName = Literal["avia", "vlp16", "os1"]
TruthName = Literal["paper", "metro", "horseshoe", "irregular", "circle"]
METRO_LENGTH = 351.0  # m of the real alignment that are at hand


@dataclass(frozen=True)
class SensorErrors:
    """Errors of the instruments. Zero, or the flag's `no-` form, switches a part off."""

    range_noise: float = 0.019  # Standard deviation of a range met squarely and near, m.
    range_noise_per_metre: float = 1e-4  # Standard deviation that each metre of range adds in quadrature, m/m.
    # Standard deviation added in quadrature per unit tangent of the incidence angle (up to 10), m.
    incidence_noise: float = 0.002
    mixed_pixels: float = 0.1  # Fraction of the beams across a depth edge whose return falls between the two surfaces.
    # Lose returns whose echo is too weak for the sensor, by range, incidence, material and speckle.
    weak_echoes: bool = True
    lost: float = 0.004  # Fraction of returns lost for no reason modelled here.
    # Measure each point from the pose of its own time; otherwise whole sweeps from that of their stamp.
    distortion: bool = True
    imu_noise: bool = True  # White noise of accelerometer and gyroscope, and wander of the orientation.
    imu_bias: bool = True  # A constant bias and its random walk.
    prism_noise: float = 0.0025  # Standard deviation of the total station in each axis, m.


@dataclass(frozen=True)
class SurveyConfig:
    """Simulates the survey of one bore and writes it with its truth.

    Example: python -m scene.survey --truth metro --length 60 --out build/survey
    """

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]  # Folder to write to; made if missing.
    truth: TruthName = "paper"  # Kind of bore.
    length: float = 60.0  # Length of the bore along its centreline, m.
    seed: int = 0  # Draws all that is random; the same seed gives the same bytes.
    # Draw sizes (gauge, rings, pockets ...) within building tolerance.
    tolerances: bool = False
    texture: float = 0.0  # Brightness of the lining: from 0, all alike, to 1, an old, wet metro.
    correlation: float = 2.0  # Correlation length of the walls of `irregular`, m.
    # LiDARs, each with its own recording; with none, the truth alone.
    sensors: tuple[LidarName, ...] = ("avia",)
    scan_every: int = 1  # Keep every so many scans of the VLP-16 and the OS1.
    speed: float = 1.0  # Mean walking speed, m/s.
    point_rate: int = 240_000  # Points per second of the Avia; fewer thin the survey.
    # Errors of the instruments. Zero, or the flag's `no-` form, switches a part off.
    errors: SensorErrors = field(default_factory=SensorErrors)
    # Conventions of drivers that the recordings are written in.
    convention: Convention = field(default_factory=Convention)


def check_survey(config: SurveyConfig) -> None:
    """Refuses what cannot be simulated: raises `ValueError` for a field out of range, or an `out` that is a file."""
    if not 10.0 < config.length <= 2000.0:
        raise ValueError(f"length must be more than 10 m and at most 2000 m, got {config.length:g}")
    if config.truth == "metro" and config.length > METRO_LENGTH:
        raise ValueError(f"length must be at most {METRO_LENGTH:g} m for truth metro, got {config.length:g}")
    if not 0.1 <= config.speed <= 10.0:
        raise ValueError(f"speed must lie between 0.1 and 10 m/s, got {config.speed:g}")
    if config.seed < 0:
        raise ValueError(f"seed must not be negative, got {config.seed}")
    if not 60 <= config.point_rate <= 240_000 or config.point_rate % 60:
        raise ValueError(f"point_rate must be a multiple of 60 between 60 and 240000, got {config.point_rate}")
    if not 1.0 <= config.correlation <= 4.0:
        raise ValueError(f"correlation must lie between 1 and 4 m, got {config.correlation:g}")
    if config.scan_every < 1:
        raise ValueError(f"scan_every must be at least 1, got {config.scan_every}")
    if len(set(config.sensors)) < len(config.sensors):
        raise ValueError(f"sensors must differ from each other, got {' '.join(config.sensors)}")
    check_dial(config.texture)
    _check_errors(config.errors)
    config.convention.check()
    # The nearest existing parent decides whether the folder can be made.
    for folder in (config.out, *config.out.parents):
        if folder.exists():
            if not folder.is_dir():
                raise ValueError(f"out must be a folder, but {folder} is a file")
            return


def _check_errors(errors: SensorErrors) -> None:
    for name in ("range_noise", "range_noise_per_metre", "incidence_noise", "prism_noise"):
        value = getattr(errors, name)
        if not 0.0 <= value < math.inf:
            raise ValueError(f"errors.{name} must not be negative, got {value:g}")
    for name in ("mixed_pixels", "lost"):
        value = getattr(errors, name)
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"errors.{name} must lie between 0 and 1, got {value:g}")
