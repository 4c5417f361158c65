"""Finds places inside a bore and follows it, metre by metre, both ways, until nothing encloses the way any more.

A place is where the cloud, looked at along one direction, draws a closed ring around an open middle. A bore is what
stays the same along its axis. Its direction is the one along which the returns around a place fall on the fewest cells
of a plane.

Each section is laid on the template of the last few metres by what fits it. A niche, a vehicle or a wall in shadow fits
nothing and so moves nothing; a section that changes over several metres becomes the template.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation, distance_transform_edt
from scipy.spatial import cKDTree

from scene.geometry import angle_bins, bin_angles, bin_medians, find_runs

_TILE = 6.0  # m between places tried
_MOST = 60  # places
_REACH = 10.0  # m around a place whose returns tell the direction
_CELL = 0.25  # m
_SLAB = 3.0  # m before and behind a place that draw the ring
_HEADINGS = 24  # tried over half a turn
_SLOPES = np.tan(np.deg2rad([-18, -12, -6, 0, 6, 12, 18]))
N_RAYS = 72  # directions around a section
_LUMENS = 6  # open middles tried at a place
_LEAST_CLEARANCE = 0.5  # m
_FURTHEST = 15.0  # m
_MOST_POINTS = 6000  # about a place that tell its direction


@dataclass(frozen=True)
class Seed:
    """A place inside a bore."""

    position: Float[np.ndarray, "3"]  # m
    direction: Float[np.ndarray, "3"]  # Unit vector along the bore
    radius: Float[np.ndarray, " rays"]  # Distance to the first return around, m; NaN where there is none
    enclosed: float  # Fraction of the directions around in which there is a return
    score: float  # Fraction of the returns seen from here, times the square of `enclosed`

    @property
    def width(self) -> float:
        """Extent across, from left to right, m."""
        across = (self.radius * np.cos(bin_angles(N_RAYS)))[np.isfinite(self.radius)]
        return float(np.ptp(across))


def frame_of(direction: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the horizontal vector to the left of a direction, and the one above it."""
    left = np.array([-direction[1], direction[0], 0.0])
    left /= max(float(np.linalg.norm(left)), 1e-9)
    (x, y, z), (a, b, c) = direction, left  # `np.cross` takes ten times as long
    return left, np.array([y * c - z * b, z * a - x * c, x * b - y * a])


def find_seeds(points: Float[np.ndarray, "n 3"]) -> list[Seed]:
    """Return places inside bores, the likeliest first; a bore may have many, an open place has none well enclosed."""
    middles = (np.unique(np.floor(points[:, :2] / _TILE), axis=0) + 0.5) * _TILE
    tree = cKDTree(points[:, :2])
    count = np.array([len(rows) for rows in tree.query_ball_point(middles, _TILE)])
    middles = middles[count > 0.3 * np.median(count)]
    middles = middles[:: max(1, -(-len(middles) // _MOST))]
    result = []
    for rows in tree.query_ball_point(middles, _REACH):
        near = points[rows[:: max(1, len(rows) // _MOST_POINTS)]]
        if len(near) > 100:
            result.extend(_seeds_at(near))
    return sorted(result, key=lambda seed: -seed.score)


def _seeds_at(near: np.ndarray) -> list[Seed]:
    direction = sweep_direction(near)
    left, up = frame_of(direction)
    middle = np.median(near, axis=0)
    along, across, upward = ((near - middle) @ vector for vector in (direction, left, up))
    slab = np.abs(along) < _SLAB
    if slab.sum() < 50:
        return []
    y, z = across[slab], upward[slab]
    low = np.array([y.min(), z.min()]) - 4 * _CELL
    shape = np.ceil((np.array([y.max(), z.max()]) - low) / _CELL).astype(int) + 4
    cell = np.floor((np.stack([y, z], axis=1) - low) / _CELL).astype(int)
    count = np.zeros(shape, int)
    np.add.at(count, tuple(cell.T), 1)
    solid = binary_dilation(count > 0, np.ones((2, 2), bool))
    clear = distance_transform_edt(np.pad(~solid, 1))[1:-1, 1:-1] * _CELL
    result, free = [], clear.copy()
    for _ in range(_LUMENS):
        at = np.unravel_index(int(free.argmax()), free.shape)
        clearance = free[at]
        if clearance < _LEAST_CLEARANCE:
            break
        grid = np.stack(np.meshgrid(*(np.arange(n) for n in free.shape), indexing="ij"), axis=-1)
        free[np.linalg.norm((grid - at) * _CELL, axis=-1) < clearance] = 0.0
        radius, seen = _cast(solid, count, np.array(at, float))
        enclosed = float(np.isfinite(radius).mean())
        if enclosed < 0.5:
            continue
        place = low + (np.array(at) + 0.5) * _CELL
        turn = bin_angles(N_RAYS)
        shift = _centroid(turn, radius)
        moved = np.array(at) + shift / _CELL
        inside = np.clip(np.rint(moved).astype(int), 0, np.array(solid.shape) - 1)
        if not solid[tuple(inside)]:
            radius, seen = _cast(solid, count, moved)
            enclosed, place = float(np.isfinite(radius).mean()), place + shift
        position = middle + place[0] * left + place[1] * up
        result.append(Seed(position, direction, radius, enclosed, enclosed**2 * seen / len(y)))
    return result


def sweep_direction(near: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Return the unit vector along which points fall on the fewest cells of the plane square to it."""
    centred = near - near.mean(axis=0)

    def cells(heading: float, slope: float) -> int:
        direction = np.array([np.cos(heading), np.sin(heading), slope])
        row, column = (
            np.floor(centred @ vector / _CELL).astype(np.int64)
            for vector in frame_of(direction / np.linalg.norm(direction))
        )
        taken = np.zeros((np.ptp(row) + 1, np.ptp(column) + 1), bool)
        taken[row - row.min(), column - column.min()] = True
        return int(np.count_nonzero(taken))

    best = min((cells(turn, 0.0), turn, 0.0) for turn in np.pi * np.arange(_HEADINGS) / _HEADINGS)
    best = min((cells(best[1], slope), best[1], float(slope)) for slope in _SLOPES)
    step = np.pi / _HEADINGS / 2
    for _ in range(3):
        around = [(best[1] + i * step, best[2] + j * step) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        best = min((cells(*at), *at) for at in around)
        step /= 2
    direction = np.array([np.cos(best[1]), np.sin(best[1]), best[2]])
    return direction / np.linalg.norm(direction)


def _cast(solid: np.ndarray, count: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, int]:
    """Distance to the first solid cell in each direction, m, NaN without one, and the returns in the cells seen."""
    turn = bin_angles(N_RAYS)
    steps = np.arange(1, int(_FURTHEST / _CELL * 2)) / 2
    where = at + steps[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    cell = np.rint(where).astype(int)
    inside = ((cell >= 0) & (cell < solid.shape)).all(axis=2)
    cell = np.clip(cell, 0, np.array(solid.shape) - 1)
    hit = solid[cell[..., 0], cell[..., 1]] & inside
    first = hit.argmax(axis=0)
    met = hit.any(axis=0)
    seen = np.zeros(solid.shape, bool)
    seen[tuple(cell[first[met], np.flatnonzero(met)].T)] = True
    seen = binary_dilation(seen, np.ones((3, 3), bool))
    return np.where(met, steps[first] * _CELL, np.nan), int(count[seen].sum())


def _centroid(turn: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Middle of the box around the ring, from where it was drawn, m."""
    seen = np.isfinite(radius)
    y, z = (radius * np.cos(turn))[seen], (radius * np.sin(turn))[seen]
    return np.array([y.min() + y.max(), z.min() + z.max()]) / 2


STEP = 1.0  # m
_HALF_SLAB = 0.75  # m
_GATE = 0.5  # m from the template: further is another thing
_REMEMBERED = 12  # sections in the template
_RECENT = 3  # sections in the template of a section that changes fast
_HEADED = 8  # m of way that give the direction
_ENCLOSED = 0.62  # fraction of the directions matched
_OPEN = 0.45  # fraction with any return near the template's size: less is no bore
_SIZE = 2.2  # times the template
_LONGEST_GAP = 15  # m without an enclosing section
_PULL = 3.0  # bins that the prediction counts for
_MIN_RETURNS = 12  # in a slab; fewer are a gap
_ROUNDS = 3  # times that a section is laid on its template
_AROUND = 10  # sections on each side of unsteady ones that tell where they are
_TURN = bin_angles(N_RAYS)


@dataclass(frozen=True)
class Course:
    """A bore followed from end to end."""

    position: Float[np.ndarray, "n 3"]  # Middle of each section, m
    steady: Bool[np.ndarray, " n"]  # The section fits those of the last 12 m; elsewhere the middle is interpolated
    radius: Float[np.ndarray, "n rays"]  # Template about the middle, m

    def reversed(self) -> "Course":
        """Return the same bore from the other end, in which left and right change places."""
        turned = self.radius[::-1, (N_RAYS // 2 - 1 - np.arange(N_RAYS)) % N_RAYS]
        return Course(self.position[::-1], self.steady[::-1], turned)

    @property
    def length(self) -> float:
        """Length of the polygon, m."""
        return float(np.linalg.norm(np.diff(self.position, axis=0), axis=1).sum())

    @property
    def usual(self) -> Float[np.ndarray, " rays"]:
        """Distance of the wall from the middle in each direction, in the median along the bore, m."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a direction that nobody saw
            return _filled(np.nanmedian(self.radius, axis=0))

    @property
    def width(self) -> float:
        """Extent across, from left to right, m."""
        return float(np.ptp(self.usual * np.cos(_TURN)))


def follow_bore(points: Float[np.ndarray, "n 3"], tree: cKDTree, seed: Seed) -> Course:
    """Follows the bore of a seed to both of its ends."""
    ahead = _follow(points, tree, seed, seed.direction)
    back = _follow(points, tree, seed, -seed.direction)
    both = [*back[::-1], *ahead[1:]]
    steady = np.array([step[1] for step in both])
    return Course(_bridged(np.array([step[0] for step in both]), steady), steady, np.array([step[2] for step in both]))


_TAIL = 8  # sections that tell where a course heads at its end
_ACROSS, _OVERLAP = 10.0, -4.0  # m from the end of one course to the begin of the next, along the first
_BESIDE = 2.0  # m aside of its line
_ALIGNED = 0.9  # cosine between both headings


def join_courses(courses: list[Course]) -> list[Course]:
    """Return courses with those in one that go on from one another: between them the section changes at once."""
    left = sorted(courses, key=lambda course: -course.length)
    k = 0
    while k < len(left):
        for other in range(k + 1, len(left)):
            both = _join(left[k], left[other])
            if both is not None:
                left[k] = both
                del left[other]
                break
        else:
            k += 1
    return left


def _join(one: Course, other: Course) -> Course | None:
    """Return two courses in a row; `None` where neither goes on from the other."""
    if min(len(one.position), len(other.position)) < _TAIL:
        return None
    for first in (one, one.reversed()):
        for second in (other, other.reversed()):
            tail, head = first.position[-_TAIL:], second.position[:_TAIL]
            heading, onwards = (part[-1] - part[0] for part in (tail, head))
            heading, onwards = heading / np.linalg.norm(heading), onwards / np.linalg.norm(onwards)
            ahead = (head - tail[-1]) @ heading
            aside = float(np.linalg.norm(head[0] - tail[-1] - ahead[0] * heading))
            if not _OVERLAP < ahead[0] < _ACROSS or aside > _BESIDE or heading @ onwards < _ALIGNED:
                continue
            fresh = int(np.argmax(ahead > STEP / 2))  # before it both were followed
            if ahead[fresh] > 0.0:
                names = ("position", "steady", "radius")
                return Course(*(np.concatenate([getattr(first, n), getattr(second, n)[fresh:]]) for n in names))
    return None


def _bridged(position: np.ndarray, steady: np.ndarray) -> np.ndarray:
    """Replaces the middles of unsteady sections: by a cubic through those around, by a line beyond the last one."""
    at = np.arange(len(position), dtype=float)
    result = position.copy()
    for first, last in find_runs(~steady):
        before, behind = (np.flatnonzero(steady[:first])[-_AROUND:], last + np.flatnonzero(steady[last:])[:_AROUND])
        rows = np.concatenate([before, behind])
        if len(rows) < 2:
            continue
        degree = min(3, len(rows) - 1) if len(before) and len(behind) else 1
        middle = at[rows].mean()
        fitted = np.polyfit(at[rows] - middle, position[rows], degree)
        result[first:last] = np.stack([np.polyval(fitted[:, k], at[first:last] - middle) for k in range(3)], axis=1)
    return result


def _follow(
    points: np.ndarray, tree: cKDTree, seed: Seed, direction: np.ndarray
) -> list[tuple[np.ndarray, bool, np.ndarray]]:
    mirrored = direction @ seed.direction < 0
    first = seed.radius[(N_RAYS // 2 - 1 - np.arange(N_RAYS)) % N_RAYS] if mirrored else seed.radius
    template = _filled(first)
    history = [template] * 2
    steps = [(seed.position, True, seed.radius)]
    position, lost = seed.position, 0
    while lost <= _LONGEST_GAP and len(steps) < 100_000:
        position = position + STEP * direction
        recent = np.median(history[-_RECENT:], axis=0)
        shift, matched, steady, section = _lay(points, tree, position, direction, template, recent)
        left, up = frame_of(direction)
        if matched >= _ENCLOSED:
            lost = 0
            position = position + shift[0] * left + shift[1] * up
            history = [*history, section][-_REMEMBERED:]
            template = np.median(history, axis=0)
        else:
            lost += 1
        seen = template[(N_RAYS // 2 - 1 - np.arange(N_RAYS)) % N_RAYS] if mirrored else template
        steps.append((position, matched >= _ENCLOSED and steady >= _ENCLOSED, seen))
        if lost == 0:
            direction = _heading([step[0] for step in steps[-_HEADED:]], direction)
    return steps[: len(steps) - lost]


def _heading(places: Sequence[np.ndarray], before: np.ndarray) -> np.ndarray:
    """Direction of the last few middles; while they are few, mostly the one before."""
    at = np.asarray(places)
    if len(at) < 3:
        return before
    centred = at - at.mean(axis=0)
    along = np.arange(len(at)) - (len(at) - 1) / 2
    fitted = along @ centred / (along @ along)
    fraction = len(at) / _HEADED * 0.5
    mixed = fraction * fitted / max(float(np.linalg.norm(fitted)), 1e-9) + (1 - fraction) * before
    return mixed / np.linalg.norm(mixed)


def _lay(
    points: np.ndarray,
    tree: cKDTree,
    position: np.ndarray,
    direction: np.ndarray,
    template: np.ndarray,
    recent: np.ndarray,
) -> tuple[np.ndarray, float, float, np.ndarray]:
    """Return how far a section's middle is to the left and above of a place, and the section about it.

    Between them: the fraction of its directions that match either template, and the fraction that match the longer one.
    """
    reach = _SIZE * float(template.max())
    near = points[tree.query_ball_point(position, reach)] - position
    slab = near[np.abs(near @ direction) < _HALF_SLAB]
    none = np.zeros(2), 0.0, 0.0, template
    if len(slab) < _MIN_RETURNS:
        return none
    left, up = frame_of(direction)
    place = np.stack([slab @ left, slab @ up], axis=1)
    shift = np.zeros(2)
    best = template
    for _ in range(_ROUNDS):
        bins, radius = _polar(place - shift)
        off = [_bin_off(bins, radius - shape[bins]) for shape in (template, recent)]
        best = template if np.isfinite(off[0]).sum() >= np.isfinite(off[1]).sum() else recent
        e = off[0] if best is template else off[1]
        fits = np.isfinite(e)
        if fits.mean() < 0.3:
            break
        normal = _normals(best)[fits]
        shift = shift + np.linalg.solve(normal.T @ normal + _PULL * np.eye(2), normal.T @ e[fits])
    bins, radius = _polar(place - shift)
    long, brief = (np.isfinite(_bin_off(bins, radius - shape[bins])) for shape in (template, recent))
    return shift, float((long | brief).mean()), float(long.mean()), _section(bins, radius, best)


def _polar(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    turn = np.arctan2(place[:, 1], place[:, 0])
    return angle_bins(turn, N_RAYS), np.hypot(*place.T)


def _bin_off(bins: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Median distance from the template of what is near it in each direction, m; NaN where nothing is."""
    near = np.abs(off) < _GATE
    return bin_medians(bins[near], off[near], N_RAYS)


def _section(bins: np.ndarray, radius: np.ndarray, template: np.ndarray) -> np.ndarray:
    """Radius in each direction: of what is near the template, else of all that is there, else the template's."""
    near = np.abs(radius - template[bins]) < _GATE
    best, any_ = bin_medians(bins[near], radius[near], N_RAYS), bin_medians(bins, radius, N_RAYS)
    return np.where(np.isfinite(best), best, np.where(np.isfinite(any_), any_, template))


def _normals(radius: np.ndarray) -> np.ndarray:
    """Outward unit normals of the ring, divided by what they make of a radial distance, `(rays, 2)`."""
    slope = (np.roll(radius, -1) - np.roll(radius, 1)) / (4 * np.pi / N_RAYS) / radius
    slope = np.clip(slope, -1.0, 1.0)  # d(log r): the ring leans so much
    radial = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1)
    around = np.stack([-np.sin(_TURN), np.cos(_TURN)], axis=1)
    return radial - slope[:, None] * around


def _filled(radius: np.ndarray) -> np.ndarray:
    seen = np.isfinite(radius)
    return np.interp(_TURN, _TURN[seen], radius[seen], period=2 * np.pi)
