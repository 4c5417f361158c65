"""Extent as a user states it: a box, stations from and to, the direction, and the chainage of the first station."""

from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import tyro
from jaxtyping import Float

from scene.cleaning.removed import Cleaned, part_of_cloud
from scene.cloud import Cloud
from scene.errors import FitError
from scene.fitting.section import DENSE_STEP, OVERRUN, visible_span
from scene.geometry import Axis, make_axis

_FLAG = tyro.conf.arg(prefix_name=False)
_AXIS_STEP = 1.0  # m
_SHORTEST = 5.0  # m between `--from` and `--to`


@dataclass(frozen=True)
class ExtentConfig:
    """The part of an input that is built, and how its stations count."""

    # Box in the input's frame, m, that is kept: x,y,z,x,y,z of two corners, or x,y,x,y in plan.
    crop: Annotated[str | None, _FLAG] = None
    # First station that is built, m, counted as the whole build counts them.
    first: Annotated[float | None, tyro.conf.arg(name="from", prefix_name=False)] = None
    last: Annotated[float | None, tyro.conf.arg(name="to", prefix_name=False)] = None  # Last station, m.
    reverse: Annotated[bool, _FLAG] = False  # Count stations from the other end.
    start_chainage: Annotated[float, _FLAG] = 0.0  # Chainage of station 0, m, for people and the manifest.


def parse_box(text: str) -> Float[np.ndarray, "2 3"]:
    """Return the corners of a box, lower first, m; infinite in height where only the plan is given.

    Raises `FitError` for a text that is neither four nor six numbers, or a box without a volume.
    """
    try:
        numbers = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) not in (4, 6) or not np.isfinite(numbers).all():
        raise FitError(f"--crop is x,y,z,x,y,z of two corners or x,y,x,y in plan, in m, got {text!r}")
    pair = np.sort(numbers.reshape(2, -1), axis=0)
    corners = np.array([[-np.inf] * 3, [np.inf] * 3])
    corners[:, : pair.shape[1]] = pair
    if (corners[0] >= corners[1]).any():
        raise FitError(f"--crop {text}: the box is empty")
    return corners


def crop_cloud(cloud: Cloud, crop: str | None) -> Cloud:
    """Return the points of a cloud inside a box of the input's frame; all where there is none.

    Raises `FitError` where the box is none, or holds no point.
    """
    if crop is None:
        return cloud
    low, high = parse_box(crop) - cloud.origin
    rows = np.flatnonzero(((cloud.points >= low) & (cloud.points <= high)).all(axis=1))
    if not len(rows):
        lowest, highest = (f(cloud.points, axis=0) + cloud.origin for f in (np.min, np.max))
        spans = ", ".join(f"{a} {x:.1f} to {y:.1f}" for a, x, y in zip("xyz", lowest, highest, strict=True))
        raise FitError(f"--crop {crop} holds no point; the cloud spans {spans} m")
    return part_of_cloud(cloud, rows)


def turn_round(cleaned: Cleaned) -> Cleaned:
    """Return the same cloud with an axis that runs the other way."""
    removed = tuple(part.reversed(cleaned.axis.length) for part in reversed(cleaned.removed))
    return replace(cleaned, axis=cleaned.axis.reversed(), removed=removed)


def keep_stations(cleaned: Cleaned, everything: Cloud, config: ExtentConfig) -> tuple[Cleaned, Cloud, float]:
    """Keep what lies between two stations, counted from the first one that enough was seen of, as the whole build does.

    Returns both clouds, cut, and the station of the whole build at which the rest begins, m. Raises `FitError` where
    the stations leave less than 5 m.
    """
    if config.first is None and config.last is None:
        return cleaned, everything, 0.0
    axis = cleaned.axis
    whole = axis.at(np.arange(-OVERRUN, axis.length + OVERRUN, DENSE_STEP))
    station, lateral, upward = whole.local(cleaned.cloud.points.astype(np.float64))
    start, end = visible_span(station, np.arctan2(upward, lateral), axis)
    first, last = config.first or 0.0, end - start if config.last is None else config.last
    last = min(last, end - start)
    if last - first < _SHORTEST:
        raise FitError(
            f"--from {first:g} and --to {last:g} leave {max(last - first, 0.0):.1f} m of a tunnel of "
            f"{end - start:.1f} m; at least {_SHORTEST:g} m are needed"
        )
    low, high = start + first, start + last
    kept = part_of_cloud(cleaned.cloud, np.flatnonzero((station >= low) & (station <= high)))
    all_stations = whole.local(everything.points.astype(np.float64))[0]
    rows = np.flatnonzero((all_stations >= low) & (all_stations <= high))
    removed = tuple(part.shifted(-low) for part in cleaned.removed if part.end > low and part.start < high)
    short = Cleaned(kept, _part_of_axis(axis, low, high), removed, cleaned.cause[rows], cleaned.behind)
    return short, part_of_cloud(everything, rows), first


def _part_of_axis(axis: Axis, low: float, high: float) -> Axis:
    station = np.linspace(low, high, int(np.ceil((high - low) / _AXIS_STEP)) + 1)
    part = axis.at(station)
    return make_axis(station - low, part.position, part.tangent)


def describe_chainage(config: ExtentConfig, first: float, grows: str) -> dict[str, Any]:
    """Return the chainage of station 0, m, and the way it grows, for the manifest.

    `first` is the station of the whole build at which this one begins, m; `grows` the way without `--reverse`, in
    words.
    """
    way = f"against this, by --reverse: {grows}" if config.reverse else grows
    return {"chainage_start": config.start_chainage + first, "chainage_grows": way}
