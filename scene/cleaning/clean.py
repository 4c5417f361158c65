"""The steps of cleaning: crop, leave out strays, look for places inside a bore, follow it, sort the returns.

A cloud in which no bore can be seen is refused by the name of what it is.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter1d
from scipy.spatial import cKDTree

from scene.cleaning import sort
from scene.cleaning.follow import N_RAYS, Course, Seed, find_seeds, follow_bore, join_courses
from scene.cleaning.sort import Cleaned, look_around, part_of_cloud, sort_points
from scene.cleaning.tube import Tube, find_plane_walls, measure_tube
from scene.cloud import Cloud, thin_cloud
from scene.errors import Cause, FitError, Refusal
from scene.fitting.axis import CentrelineConfig, centre_axis, smooth_axis
from scene.geometry import Axis, bin_angles

_COARSE = 0.15  # m, voxel of the cloud that is followed
_REACH, _AROUND = 3.0, 5  # times the template, and directions around: as far as the wall is looked for
_STRETCH = 3.0  # m between two stretches of what was removed
_LITTLE = 0.002  # fraction of the points: with less to remove, the cloud is clean
_FEWEST = 200  # points
_TRIED = 8  # seeds followed
_ENCLOSED = 0.65  # fraction of the directions
_ELONGATION = 1.6  # least length over width
_ABOVE, _CROWN, _STREET = 0.8, 0.15, 7.0  # sine of directions above; fraction of them matched; m
_FLAG = tyro.conf.arg(prefix_name=False)


@dataclass(frozen=True)
class ExtentConfig:
    """The part of an input that is built, and how its stations count."""

    # Box in the input's frame, m, that is kept: x,y,z,x,y,z of two corners, or x,y,x,y in plan.
    crop: Annotated[str | None, _FLAG] = None
    reverse: Annotated[bool, _FLAG] = False  # Count stations from the other end.


def parse_box(text: str) -> Float[np.ndarray, "2 3"]:
    """Return the corners of a box, lower first, m; infinite in height where only the plan is given.

    Raises `FitError` for a text that is neither four nor six numbers, or a box without a volume.
    """
    try:
        numbers = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) not in (4, 6) or not np.isfinite(numbers).all():
        raise FitError(f"--crop is x,y,z,x,y,z of two corners or x,y,x,y in plan, in m, got {text!r}", Refusal.CROP)
    pair = np.sort(numbers.reshape(2, -1), axis=0)
    corners = np.array([[-np.inf] * 3, [np.inf] * 3])
    corners[:, : pair.shape[1]] = pair
    if (corners[0] >= corners[1]).any():
        raise FitError(f"--crop {text}: the box is empty", Refusal.CROP)
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
        raise FitError(f"--crop {crop} holds no point; the cloud spans {spans} m", Refusal.CROP)
    return part_of_cloud(cloud, rows)


def turn_round(cleaned: Cleaned) -> Cleaned:
    """Return the same cloud with an axis that runs the other way."""
    removed = tuple(part.reversed(cleaned.axis.length) for part in reversed(cleaned.removed))
    return replace(cleaned, axis=cleaned.axis.reversed(), removed=removed)


def clean_cloud(cloud: Cloud, centreline: CentrelineConfig) -> Cleaned:
    """Finds the axis of the bore in a registered cloud and cuts away what does not belong to it.

    Raises `FitError` where no bore can be seen, naming the cause.
    """
    supported = sort.has_support(cloud.points)
    thinned = thin_cloud(part_of_cloud(cloud, np.flatnonzero(supported)), _COARSE)
    coarse, count = thinned.points.astype(np.float64), thinned.weights
    if len(coarse) < _FEWEST:
        why = f"no tunnel in the cloud: it holds {len(coarse)} places of {_COARSE:g} m; {_FEWEST} are needed"
        raise FitError(why, Refusal.NO_BORE)
    seeds = find_seeds(coarse)
    course = longest_course(coarse, seeds)
    if course is None or course.length < max(centreline.min_length, _ELONGATION * course.width):
        raise refuse_cloud(coarse, seeds, course, centreline.min_length)
    axis = smooth_axis(course.position, centreline.cutoff)
    reach = _REACH * maximum_filter1d(course.usual, _AROUND, mode="wrap")
    for _ in range(2):
        tube, ends, own = _sorted_coarse(coarse, count, axis, reach)
        axis = centre_axis(coarse[own], axis, centreline, partial(stand_in, tube, axis))
    tube, ends, _own = _sorted_coarse(coarse, count, axis, reach)
    require_crown(tube)
    points = cloud.points.astype(np.float64)
    around = look_around(points, axis)
    behind, cause = sort_points(around, tube, supported, ends)
    cause = sort.name_bodies(points, cause, behind, supported)
    if (cause != Cause.KEPT).mean() < _LITTLE:
        cause[:] = Cause.KEPT
    kept = cloud if (cause == Cause.KEPT).all() else part_of_cloud(cloud, np.flatnonzero(cause == Cause.KEPT))
    usual = partial(stand_in, tube, axis)
    along = axis.at(tube.behind[:, 0])
    hidden = along.position + tube.behind[:, 1:2] * along.lateral + tube.behind[:, 2:] * along.up
    axis = axis.at(np.linspace(*ends, int(np.ptp(ends)) + 1))
    axis = centre_axis(kept.points, axis, centreline, usual)
    removed = sort.list_removed(cloud, cause, look_around(points, axis).station, _STRETCH, behind)
    return Cleaned(kept, axis, removed, cause, hidden)


def _sorted_coarse(
    coarse: np.ndarray, count: np.ndarray, axis: Axis, reach: np.ndarray
) -> tuple[Tube, tuple[float, float], Bool[np.ndarray, " n"]]:
    """Return the tube about an axis, its ends, and which points are the bore's.

    `count` is the number of points that each coarse point stands for.
    """
    around = look_around(coarse, axis)
    tube = measure_tube(around, count, axis.length, reach)
    tube = find_plane_walls(tube, around)
    ends = sort.end_stations(tube, around)
    return tube, ends, sort_points(around, tube, np.ones(len(coarse), bool), ends)[1] == Cause.KEPT


def require_crown(tube: Tube) -> None:
    """Refuses a wide tube that nearly no station shows from above; raises `FitError`."""
    above = np.sin(tube.grid.angle) > _ABOVE
    sides = np.abs(np.cos(tube.grid.angle)) > _ABOVE
    width = 2 * float(np.median(tube.usual[:, sides]))
    if width > _STREET and tube.matched[:, above].mean() < _CROWN:
        why = f"no tunnel in the cloud: open above and {width:.0f} m wide, so a street or a cutting"
        raise FitError(why, Refusal.OPEN)


def longest_course(points: Float[np.ndarray, "n 3"], seeds: list[Seed]) -> Course | None:
    """Follows the likeliest places and returns the longest bore; `None` where no place is enclosed.

    Bores that go on from one another are one. A place that is too wide for the length of the cloud lies in a room.
    """
    tree = cKDTree(points)
    courses: list[Course] = []
    for seed in seeds:
        if seed.enclosed < _ENCLOSED or len(courses) >= _TRIED:
            continue
        if float(np.ptp(points @ seed.direction)) < _ELONGATION * seed.width:
            continue
        if any(_holds(course, seed.position) for course in courses):
            continue
        courses.append(follow_bore(points, tree, seed))
    return max(join_courses(courses), key=lambda course: course.length, default=None)


def _holds(course: Course, position: np.ndarray) -> bool:
    off, nearest = cKDTree(course.position).query(position)
    return bool(off < 1.5 * np.median(course.radius[nearest]))


def stand_in(tube: Tube, axis: Axis, at: Axis) -> Float[np.ndarray, "k rays"]:
    """Return the tube's usual wall about the stations of another axis nearby, in 72 directions, m."""
    station, lateral, upward = axis.local(at.position)
    rows = np.clip(((station - tube.grid.start) / tube.grid.step).astype(np.intp), 0, tube.grid.rows - 1)
    turn = tube.grid.angle
    centres = bin_angles(N_RAYS)
    result = np.empty((len(rows), N_RAYS))
    for k, row in enumerate(rows):
        y = tube.usual[row] * np.cos(turn) - lateral[k]
        z = tube.usual[row] * np.sin(turn) - upward[k]
        angle = np.arctan2(z, y)
        order = np.argsort(angle)
        result[k] = np.interp(centres, angle[order], np.hypot(y, z)[order], period=2 * np.pi)
    return result


_FLAT = 0.04  # of the longest extent
_OPEN = 0.6  # fraction of the unseen directions that lie above
_THIN, _LOW = 0.3, 2.0  # m, heights between which a cloud may be a culvert or a pipe
_NARROW = "no tunnel was found in the cloud: a bore under about 1.5 m is too narrow to be followed, "
_TALL = 1.2  # times the larger extent in plan


def refuse_cloud(
    points: Float[np.ndarray, "n 3"], seeds: list[Seed], course: Course | None, min_length: float
) -> FitError:
    """Return the error that names what a cloud without a bore is.

    `course` is the longest bore that could be followed, shorter than `min_length`, m, or than it is wide.
    """
    centred = points - points.mean(axis=0)
    sample = centred[:: max(1, len(points) // 20_000)]
    plan = _principal(sample[:, :2])
    run, across = (_extent(sample[:, :2] @ axis) for axis in plan)
    height = _extent(sample[:, 2])
    thickness = float(np.ptp(np.percentile(sample @ _principal(sample)[2], [5, 95])))
    size = f"{run:.0f} m by {across:.0f} m in plan and {height:.0f} m high"
    short = FitError(f"the tunnel is at most {run:.1f} m long; at least {min_length:g} m are needed", Refusal.SHORT)
    narrow = FitError(_NARROW + size, Refusal.NARROW)
    if max(run, height) < min_length:
        return short
    if across < _LOW and _THIN < height < _LOW:
        return narrow
    if thickness < _FLAT * max(run, across, height):
        return FitError(f"no tunnel in the cloud: its points lie on a plane, {size}", Refusal.PLANE)
    if height > max(_TALL * run, min_length):
        return FitError(f"no tunnel in the cloud: a vertical shaft, {size}", Refusal.UPRIGHT)
    if run < min_length:
        return short
    best = max(seeds, key=lambda seed: seed.enclosed, default=None)
    if best is not None and is_open_above(best.radius):
        return FitError(f"no tunnel in the cloud: open above, so a street or a cutting, {size}", Refusal.OPEN)
    if course is not None:
        way = f"the longest way enclosed by walls is {course.length:.0f} m long and {course.width:.0f} m wide"
        return FitError(f"a room, not a tunnel: {size}; {way}", Refusal.ROOM)
    if _THIN < height < _LOW:
        return narrow
    if best is not None and best.enclosed >= _ENCLOSED:
        way = f"enclosed, and nowhere {_ELONGATION:g} times as long as it is wide"
        return FitError(f"a room, not a tunnel: {size}, {way}", Refusal.ROOM)
    return FitError(f"no tunnel in the cloud: no place in it is enclosed all around, {size}", Refusal.NO_BORE)


def _principal(centred: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "k k"]:
    return np.linalg.eigh(centred.T @ centred)[1].T[::-1]


def _extent(along: Float[np.ndarray, " n"]) -> float:
    return float(np.ptp(np.percentile(along, [0.5, 99.5])))


def is_open_above(radius: Float[np.ndarray, " rays"]) -> bool:
    """Return whether what is not seen of a section lies above, and is most of what is above."""
    turn = bin_angles(len(radius))
    unseen, above = ~np.isfinite(radius), np.sin(turn) > 0.7
    return bool(unseen[above].mean() > _OPEN and (np.sin(turn[unseen]) > 0).mean() > _OPEN)
