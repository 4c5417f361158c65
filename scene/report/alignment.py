"""An alignment in plan and profile: fitted to a bore's axis, or a design that comes along."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from scene.bore import Axis, Bore, axis_through
from scene.errors import RecordingError, require_input
from scene.report.elements import Element, Fit, fit_plan, fit_profile
from scene.report.profiles import Profile

_SAMPLE = 0.25  # m between the points of a sampled alignment
_MOSTLY = 0.5  # share of interpolated sections from which on a bore with rings is a ring survey's
_FEWEST = 20  # rings of one


@dataclass(frozen=True)
class Piece:
    """One element in plan with its place, as LandXML holds it.

    Attributes:
        start: Its beginning, x and y, m.
        heading: Direction there, anticlockwise from x, rad.
        length: Length, m.
        first: Curvature at its beginning, 1/m, to the left positive.
        last: Curvature at its end, 1/m.
    """

    start: Float[np.ndarray, "2"]
    heading: float
    length: float
    first: float
    last: float

    def at(self, along: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
        """Return positions (m) and headings (rad) at distances from its beginning, m."""
        bend = Profile(
            np.array([0.0, self.length]), np.array([self.first, self.last]), np.array([*self.start, self.heading])
        )
        return bend.plan(along)

    @property
    def kind(self) -> str:
        """`line`, `arc` or `clothoid`."""
        if self.first == self.last:
            return "line" if self.first == 0.0 else "arc"
        return "clothoid"


@dataclass(frozen=True)
class Vertical:
    """One element in profile.

    Attributes:
        start: Station at which it begins, in plan from the alignment's beginning, m.
        height: Height there, m.
        length: Length in plan, m.
        first: Grade at its beginning.
        last: Grade at its end; another one makes a parabola.
    """

    start: float
    height: float
    length: float
    first: float
    last: float

    def at(self, along: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return heights at distances from its beginning, m."""
        return self.height + (self.first + 0.5 * (self.last - self.first) * along / self.length) * along


@dataclass(frozen=True)
class Alignment:
    """Elements in plan and in profile.

    Attributes:
        name: Name.
        start: Chainage of the beginning, m.
        plan: Elements in plan, in order.
        profile: Elements in profile, in order; empty where heights are unknown.
    """

    name: str
    start: float
    plan: tuple[Piece, ...]
    profile: tuple[Vertical, ...]

    @property
    def length(self) -> float:
        """Length in plan, m."""
        return float(sum(piece.length for piece in self.plan))

    def sample(self, step: float = _SAMPLE) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """Return chainages (m) and positions (m) at most `step` apart; heights are 0 without a profile."""
        stations, points, begun = [], [], 0.0
        for piece in self.plan:
            along = np.linspace(0.0, piece.length, max(2, int(np.ceil(piece.length / step - 1e-6)) + 1))
            points.append(piece.at(along)[0][:-1])
            stations.append(begun + along[:-1])
            begun += piece.length
        last = self.plan[-1]
        stations.append(np.array([begun]))
        points.append(last.at(np.array([last.length]))[0])
        station = np.concatenate(stations)
        return self.start + station, np.column_stack([np.concatenate(points), self.heights(station)])

    def heights(self, station: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return heights at distances in plan from the beginning; beyond the profile its grade goes on, m."""
        if not self.profile:
            return np.zeros(len(station))
        begins = np.array([one.start for one in self.profile])
        number = np.clip(np.searchsorted(begins, station, side="right") - 1, 0, len(begins) - 1)
        height = np.zeros(len(station))
        for k, one in enumerate(self.profile):
            mine = number == k
            along = station[mine] - one.start
            inside = np.clip(along, 0.0, one.length)
            grade = np.where(along > inside, one.last, one.first)
            height[mine] = one.at(inside) + (along - inside) * grade
        return height


@dataclass(frozen=True)
class Design:
    """A design axis as a line through space with chainages.

    Attributes:
        name: Name of its file.
        axis: The line, its stations from 0.
        chainage: Chainage at each station of the line, m.
        has_heights: The design has a profile; else heights are 0 and mean nothing.
    """

    name: str
    axis: Axis
    chainage: Float[np.ndarray, " n"]
    has_heights: bool

    def locate(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return chainage, offset to the right and height above the design of points, m."""
        flat = points if self.has_heights else points * [1.0, 1.0, 0.0]
        station, left, up = self.axis.local(flat)
        return np.column_stack([np.interp(station, self.axis.station, self.chainage), -left, up])

    def chainages(self, bore: Bore) -> Float[np.ndarray, " n"]:
        """Return the chainage at each station of a bore, m; where the design does not reach, arc length goes on."""
        found = self.locate(bore.position)[:, 0]
        inside = np.flatnonzero((found > self.chainage.min()) & (found < self.chainage.max()))
        if len(inside) < 2:
            return found
        first, last = inside[0], inside[-1]
        way = np.sign(found[last] - found[first])
        found[:first] = found[first] - way * (bore.station[first] - bore.station[:first])
        found[last + 1 :] = found[last] + way * (bore.station[last + 1 :] - bore.station[last])
        return found


@dataclass(frozen=True)
class AlignmentFit:
    """An alignment and the two fits that it comes from."""

    alignment: Alignment
    plan: Fit
    profile: Fit


def align_bore(
    bore: Bore, name: str, origin: Float[np.ndarray, "3"], start: float, tolerance: float | None = None
) -> AlignmentFit:
    """Fit an alignment to the axis of a bore: a point a metre, or a ring survey's rings.

    Args:
        bore: The bore.
        name: Name of the alignment.
        origin: Offset of the tunnel frame, m.
        start: Chainage of station 0, m.
        tolerance: See `fit_plan`.

    Raises:
        FitError: The bore is too short.
    """
    rows = _rows_to_fit(bore)
    points = bore.position[rows]
    run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(bore.position[:, :2], axis=0).T))])[rows]
    plan, profile = fit_plan(points[:, :2], run, tolerance), fit_profile(points[:, 2], run, tolerance)
    pieces = [_piece(plan.profile, one, origin) for whole in plan.elements for one in _split(whole)]
    verticals = [
        Vertical(one.start, float(profile.profile.height(np.array([one.start]))[0] + origin[2]), one.length, one.first,
                 one.last)
        for one in profile.elements
    ]  # fmt: skip
    return AlignmentFit(Alignment(name, start, tuple(pieces), tuple(verticals)), plan, profile)


def turn_around(alignment: Alignment, start: float) -> Alignment:
    """Return the same line run from its other end, whose chainage is `start`, m."""
    plan = []
    for piece in reversed(alignment.plan):
        place, heading = piece.at(np.array([piece.length]))
        plan.append(Piece(place[0], float(heading[0]) + np.pi, piece.length, -piece.last, -piece.first))
    profile = tuple(
        Vertical(alignment.length - one.start - one.length, float(one.at(np.array([one.length]))[0]), one.length,
                 -one.last, -one.first)
        for one in reversed(alignment.profile)
    )  # fmt: skip
    return Alignment(alignment.name, start, tuple(plan), profile)


def _rows_to_fit(bore: Bore) -> Int[np.ndarray, " r"]:
    """Return rows a metre apart; of a ring survey, whose axis is interpolated in between, those of its rings."""
    last = len(bore.station) - 1
    if bore.filled.mean() > _MOSTLY and len(bore.ring_station) >= _FEWEST:
        return np.unique(np.searchsorted(bore.station, bore.ring_station - 0.5 * bore.station[1]).clip(0, last))
    every = max(1, round(1.0 / (bore.station[1] - bore.station[0])))
    return np.unique(np.append(np.arange(0, last + 1, every), last))


def _split(element: Element) -> list[Element]:
    """Return a clothoid as two where it passes through a straight, since LandXML has no other way to say it."""
    if element.first * element.last >= 0.0:
        return [element]
    middle = element.start + element.length * element.first / (element.first - element.last)
    return [
        Element(element.kind, element.start, middle, element.first, 0.0),
        Element(element.kind, middle, element.end, 0.0, element.last),
    ]


def _piece(profile: Profile, element: Element, origin: Float[np.ndarray, "3"]) -> Piece:
    at, heading = profile.plan(np.array([element.start]))
    level = element.kind == "line"
    first, last = (0.0, 0.0) if level else (element.first, element.last)
    return Piece(at[0] + origin[:2], float(heading[0]), element.length, first, last)


def design_of(alignment: Alignment, origin: Float[np.ndarray, "3"]) -> Design:
    """Return an alignment as a design axis in the tunnel frame."""
    chainage, points = alignment.sample()
    has_heights = bool(alignment.profile)
    return _design(alignment.name, chainage, points, origin, has_heights)


def _design(name: str, chainage: np.ndarray, points: np.ndarray, origin: np.ndarray, has_heights: bool) -> Design:
    points = points - (origin if has_heights else origin * [1.0, 1.0, 0.0])
    axis = axis_through(points, _SAMPLE)
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return Design(name, axis, np.interp(axis.station, run * axis.station[-1] / run[-1], chainage), has_heights)


_HEADINGS = (("CHAINAGE", "STATION"), ("EASTING", "E", "X"), ("NORTHING", "N", "Y"), ("ELEVATION", "Z", "HEIGHT"))


def read_design_table(path: Path, origin: Float[np.ndarray, "3"]) -> Design:
    """Read a design axis from CSV with the columns CHAINAGE, EASTING, NORTHING, ELEVATION (m), any order.

    Raises:
        RecordingError: A column is missing, a row is no number, or chainages do not grow.
    """
    with require_input(path).open(newline="", encoding="utf-8-sig") as file:
        rows = list(csv.reader(file))
    names = [name.strip().upper() for name in rows[0]] if rows else []
    columns = [next((names.index(name) for name in choice if name in names), None) for choice in _HEADINGS]
    if missing := [choice[0] for choice, column in zip(_HEADINGS, columns, strict=True) if column is None]:
        raise RecordingError(f"{path}: a design axis needs the column {', '.join(missing)}")
    try:
        table = np.array([[float(row[column]) for column in columns if column is not None] for row in rows[1:] if row])
    except (ValueError, IndexError) as error:
        raise RecordingError(f"{path}: a row of the design axis holds no number ({error})") from error
    if len(table) < 4 or np.any(np.diff(table[:, 0]) <= 0.0) or not np.isfinite(table).all():
        raise RecordingError(f"{path}: a design axis needs four rows or more, finite, with growing chainage")
    return _design(path.name, table[:, 0], table[:, 1:], origin, True)
