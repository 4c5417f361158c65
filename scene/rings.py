"""An as-built survey of rings: a few total-station points on each, one circle a ring, a round bore through them."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from scene import profile
from scene.axis import Axis, through
from scene.bore import POCKET, STATION_STEP, Bore
from scene.errors import FitError, RecordingError

COLUMNS = ("POINT", "EASTING", "NORTHING", "ELEVATION")
_MIN_POINTS = 5
_MIN_RINGS = 4
_LARGEST_RESIDUAL = 0.25
_PASSES = 3


@dataclass(frozen=True)
class RingSurvey:
    """Points of each ring, in the order of the file.

    Attributes:
        path: The file.
        names: Ring numbers as written.
        points: Easting, northing, elevation of each ring's points, m, `(k, 3)` each.
    """

    path: Path
    names: list[str]
    points: list[Float[np.ndarray, "k 3"]]


@dataclass(frozen=True)
class RingFit:
    """The circle of each ring.

    Attributes:
        names: Ring numbers.
        centre: m, `(r, 3)`.
        radius: m, `(r,)`.
        rms: Distance of the points from the circle, m, `(r,)`.
        seen: Share of the circumference within 22.5° of a point, `(r,)`.
    """

    names: list[str]
    centre: Float[np.ndarray, "r 3"]
    radius: Float[np.ndarray, " r"]
    rms: Float[np.ndarray, " r"]
    seen: Float[np.ndarray, " r"]


def find_survey(folder: Path) -> Path:
    """The one CSV in a folder whose header is that of a ring survey.

    Raises:
        RecordingError: None is, or several are.
    """
    matching = [path for path in sorted(folder.glob("*.csv")) if _header(path) == COLUMNS]
    if len(matching) != 1:
        found = ", ".join(path.name for path in matching) or "none"
        raise RecordingError(f"{folder}: one CSV with the columns {','.join(COLUMNS)} is needed, found {found}")
    return matching[0]


def read_survey(path: Path) -> RingSurvey:
    """Reads `POINT,EASTING,NORTHING,ELEVATION`, where POINT is `ring.point` as text (`0.10` is not `0.1`).

    Raises:
        RecordingError: Names the file and the line.
    """
    rings: dict[str, list[tuple[float, ...]]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            if tuple(reader.fieldnames or ()) != COLUMNS:
                raise RecordingError(f"{path}: columns are {reader.fieldnames}, not {','.join(COLUMNS)}")
            for row in reader:
                ring, dot, _ = (row["POINT"] or "").partition(".")
                point = tuple(float(row[column]) for column in COLUMNS[1:])
                if not dot or not np.isfinite(point).all():
                    raise ValueError(f"point {row['POINT']!r} at {point}")
                rings.setdefault(ring, []).append(point)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RecordingError(f"{path}: cannot be read ({error})") from error
    except (ValueError, TypeError) as error:
        raise RecordingError(f"{path}: line {reader.line_num} is not a ring point ({error})") from error
    if len(rings) < _MIN_RINGS:
        raise RecordingError(f"{path}: holds {len(rings)} rings; at least {_MIN_RINGS} are needed")
    return RingSurvey(path, list(rings), [np.asarray(points) for points in rings.values()])


def fit_rings(survey: RingSurvey) -> RingFit:
    """A circle through each ring's points, in the plane square to the axis through the rings' centres.

    Raises:
        FitError: A ring has too few points, or they lie on no circle.
    """
    for name, points in zip(survey.names, survey.points, strict=True):
        if len(points) < _MIN_POINTS:
            raise FitError(f"{survey.path}: ring {name} has {len(points)} points; at least {_MIN_POINTS} are needed")
    centre = np.array([points.mean(axis=0) for points in survey.points])
    for _ in range(_PASSES):
        tangent = _tangents(centre)
        fits = [_fit_circle(p, c, t) for p, c, t in zip(survey.points, centre, tangent, strict=True)]
        centre = np.array([fit[0] for fit in fits])
    radius, rms, seen = (np.array([fit[k] for fit in fits]) for k in (1, 2, 3))
    if (rms > _LARGEST_RESIDUAL).any():
        worst = int(np.argmax(rms))
        raise FitError(f"{survey.path}: ring {survey.names[worst]} is no circle (rms {rms[worst]:.2f} m)")
    return RingFit(survey.names, centre, radius, rms, seen)


def bore_from_rings(fit: RingFit, origin: Float[np.ndarray, "3"]) -> Bore:
    """A round bore through the rings; between two rings centre and radius are interpolated, and marked as filled.

    Args:
        fit: The rings, in order along the tunnel.
        origin: Whole-metre offset to take off, m.
    """
    centre = fit.centre - origin
    axis = through(centre, STATION_STEP)
    at = _ring_stations(axis, centre)
    angle = profile.angles()
    radius = np.interp(axis.station, at, fit.radius)
    distance = np.abs(axis.station[:, None] - at[None]).min(axis=1)
    return Bore(
        station=axis.station,
        position=axis.position,
        tangent=axis.tangent,
        lateral=axis.lateral,
        up=axis.up,
        width=2 * radius,
        height=2 * radius,
        angle=angle,
        radius=np.repeat(radius[:, None], len(angle), axis=1),
        residual_rms=np.interp(axis.station, at, fit.rms),
        coverage=np.interp(axis.station, at, fit.seen),
        filled=distance > STATION_STEP,
        ring_station=at,
        pocket=np.empty(0, POCKET),
    )


def _header(path: Path) -> tuple[str, ...]:
    try:
        with path.open(encoding="utf-8-sig") as file:
            return tuple(file.readline().strip().split(","))
    except (OSError, UnicodeDecodeError):
        return ()


def _tangents(centre: np.ndarray) -> np.ndarray:
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centre, axis=0), axis=1))])
    tangent = CubicSpline(chord, centre)(chord, 1)
    return tangent / np.linalg.norm(tangent, axis=1, keepdims=True)


def _fit_circle(points: np.ndarray, centre: np.ndarray, tangent: np.ndarray) -> tuple[np.ndarray, float, float, float]:
    lateral = np.cross([0.0, 0.0, 1.0], tangent)
    lateral /= np.linalg.norm(lateral)
    up = np.cross(tangent, lateral)
    x, y = (points - centre) @ lateral, (points - centre) @ up

    def misfit(circle: np.ndarray) -> np.ndarray:
        return np.hypot(x - circle[0], y - circle[1]) - circle[2]

    start = [0.0, 0.0, float(np.hypot(x, y).mean())]
    a, b, radius = least_squares(misfit, start, loss="soft_l1", f_scale=0.02).x
    angle = np.arctan2(y - b, x - a)
    around = profile.angles()
    gap = np.abs(np.angle(np.exp(1j * (around[:, None] - angle[None])))).min(axis=1)
    moved = centre + a * lateral + b * up + ((points - centre) @ tangent).mean() * tangent
    return (
        moved,
        float(radius),
        float(np.sqrt(np.mean(misfit(np.array([a, b, radius])) ** 2))),
        float((gap < np.pi / 8).mean()),
    )


def _ring_stations(axis: Axis, centre: np.ndarray) -> Float[np.ndarray, " r"]:
    return np.clip(axis.local(centre)[0], 0.0, axis.length)
