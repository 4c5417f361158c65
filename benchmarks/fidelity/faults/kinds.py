"""Faults as rows: their kinds, the site that they are put into, controls and local faults by dose."""

import csv
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float

from benchmarks.fidelity.candidate import Bore, Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.files import FidelityError
from benchmarks.fidelity.table import CATEGORIES

RAMP = 0.5  # m before and after a local fault over which it grows
MESHES = ("lining", "solid", "nails", "bed", "extra")
TRACK = ("sleeper_mesh", "rail_mesh", "fastening_mesh")
RAILS = ("rail_mesh", "fastening_mesh", "rail")
EVERYTHING = (*MESHES, *TRACK, "rail", "sleeper", "bore")
_RAIL_EDGE = 0.5  # m
_ARM = 1.0  # m from the axis at which a section's stretch is measured

Points = Float[np.ndarray, "n 3"]
PointMap = Callable[[Points], Points]


@dataclass(frozen=True)
class Fault:
    """One fault."""

    kind: str  # Name in `KINDS`
    size: float = 1.0  # Size in the unit of its kind; a sign tells the direction
    start: float | None = None  # Station where it is first at full size, m; all of the tunnel where `None`
    length: float = 0.0  # Length at full size, m
    # Angle of the part of the section that it is at, from left towards up, rad; kinds that have none ignore it
    side: float = 0.0

    def weight(self, station: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return 1 along the fault, 0 beyond its ramps, smooth between."""
        if self.start is None:
            return np.ones(len(station))
        beyond = np.maximum(np.maximum(self.start - station, station - self.start - self.length), 0.0)
        return smooth_step(1.0 - beyond / RAMP)


@dataclass(frozen=True)
class Site:
    """A case to put faults into."""

    case: Case  # The case as it is
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))  # Random numbers of the fault
    scratch: Path = Path("scratch")  # A folder to write a changed scene into
    # Function that loads another tunnel of the same class; `None` where there is none
    foreign: Callable[[], Candidate] | None = None

    @property
    def candidate(self) -> Candidate:
        return self.case.candidate

    @cached_property
    def line(self) -> Curve:
        return Curve(self.candidate.bore.station, self.candidate.bore.position)

    def moved(self, shift: Callable[[Points], Points], parts: tuple[str, ...] = EVERYTHING) -> Candidate:
        """Return the candidate with its points moved by a shift of their station, left and up.

        Args:
            shift: Function from station, left and up to what is added to them; 0 leaves a point exactly alone.
            parts: What to move, of `EVERYTHING`.
        """

        def move(points: Points) -> Points:
            local = self.line.local(points)
            by = shift(local)
            rows = np.abs(by).max(axis=1) > 0.0
            result = points.copy()
            result[rows] = self.line.point(local[rows] + by[rows])
            return result

        return warp(self.candidate, move, parts)


def local_site(case: Case) -> Site:
    """Return the site of local faults; the candidate's rails, boxes of some metres, are cut into short ones first."""
    track, line = case.candidate.track, Site(case).line
    if not len(track.rail_mesh.faces):
        return Site(case)
    fine = trimesh.remesh.subdivide_to_size(track.rail_mesh.vertices, track.rail_mesh.faces, _RAIL_EDGE, max_iter=20)
    rail = {side: _denser(points, line) for side, points in track.rail.items()}
    cut = replace(track, rail_mesh=trimesh.Trimesh(fine[0], fine[1], process=False), rail=rail)
    return Site(replace(case, candidate=replace(case.candidate, track=cut), cache={}))


def _denser(points: Points, line: Curve) -> Points:
    """Return points every `_RAIL_EDGE` along a line of points, m."""
    if len(points) < 2:
        return points
    station = line.local(points)[:, 0]
    order = np.argsort(station, kind="stable")
    at = np.union1d(station, np.arange(station.min(), station.max(), _RAIL_EDGE))
    return np.column_stack([np.interp(at, station[order], axis) for axis in points[order].T])


@dataclass(frozen=True)
class Kind:
    """A kind of fault."""

    words: str  # Fault in words
    unit: str  # Unit of its size: `m`, `rad`, `1` (a fraction or factor) or `count`
    # Function that carries it out; it returns the changed candidate, or the case where references change
    change: Callable[[Site, Fault], Candidate | Case]
    signed: bool = True  # True where it goes both ways
    sides: tuple[float, ...] = (0.0,)  # Angles that a random `side` is drawn from, rad
    doses: tuple[float, ...] = ()  # Sizes of a control that `controls` runs with a user's own kind; empty for none
    # Points that a category must lose at least at the largest of them
    falls: dict[str, float] = field(default_factory=dict)


KINDS: dict[str, Kind] = {}


def fault_kind(name: str, words: str, unit: str = "1", **more: object) -> Callable[[Callable], Callable]:
    """Registers the function that puts in a kind of fault.

    Args:
        name: Unique name.
        words: Fault in words.
        unit: Unit of its size.
        **more: Further fields of `Kind`; with `doses` and `falls` a kind from outside is a control too.

    Raises:
        FidelityError: The name is taken, or is no file's, or `falls` names no category.
    """
    if name in KINDS:
        raise FidelityError(f"fault {name!r}: this kind is registered twice")
    if "/" in name or name in suite_controls():
        raise FidelityError(f"fault {name!r}: the name has a slash, or is that of a control; choose another")

    def register(change: Callable) -> Callable:
        kind = Kind(words, unit, change, **more)  # type: ignore[arg-type]
        if unknown := set(kind.falls) - set(CATEGORIES):
            raise FidelityError(f"fault {name!r}: unknown category {min(unknown)!r} in falls")
        KINDS[name] = replace(kind, doses=tuple(map(float, kind.doses)))
        return change

    return register


def put_in(site: Site, fault: Fault) -> Case:
    """Return the case with one fault; nothing computed of the case as it is stays with it.

    Raises:
        KeyError: No such kind.
        FidelityError: A kind from outside raises, or returns neither.
    """
    try:
        changed = KINDS[fault.kind].change(site, fault)
    except Exception as error:
        if fault.kind not in outside_kinds():
            raise
        raise FidelityError(f"fault {fault.kind!r}: {type(error).__name__}: {error}") from error
    if not isinstance(changed, Candidate | Case):
        raise FidelityError(f"fault {fault.kind!r}: returns {type(changed).__name__}, and no Candidate or Case")
    return changed if isinstance(changed, Case) else replace(site.case, candidate=changed, cache={})


def smooth_step(value: np.ndarray) -> np.ndarray:
    """Return 0 below 0, 1 above 1, and a smooth ramp between."""
    inside = np.clip(value, 0.0, 1.0)
    return inside**2 * (3.0 - 2.0 * inside)


def along(axis: int, values: np.ndarray) -> Points:
    """Return shifts along one axis: 0 station, 1 left, 2 up."""
    by = np.zeros((len(values), 3))
    by[:, axis] = values
    return by


# Maps of space, applied to all of a candidate.


def warp(candidate: Candidate, move: PointMap, parts: tuple[str, ...] = EVERYTHING) -> Candidate:
    """Moves points of a candidate; stations become arc length of the moved axis."""
    track = candidate.track
    laid: dict[str, object] = {name: warp_mesh(getattr(track, name), move) for name in TRACK if name in parts}
    if "rail" in parts:
        laid["rail"] = {side: move(points) if len(points) else points for side, points in track.rail.items()}
    if "sleeper" in parts and len(track.sleeper):
        laid["sleeper"] = move(track.sleeper)
    own: dict[str, object] = {name: warp_mesh(getattr(candidate, name), move) for name in MESHES if name in parts}
    if "bore" in parts:
        own["bore"] = warp_bore(candidate.bore, move)
    return replace(candidate, track=replace(track, **laid), **own)  # type: ignore[arg-type]


def warp_mesh(mesh: trimesh.Trimesh, move: PointMap) -> trimesh.Trimesh:
    if not len(mesh.faces):
        return mesh
    return trimesh.Trimesh(move(np.asarray(mesh.vertices, float)), mesh.faces, process=False)


def warp_bore(bore: Bore, move: PointMap) -> Bore:
    """Moves axis and frames; width, height and radii grow as the map stretches a section at its axis."""
    position = move(bore.position)
    station = Curve.through(position).station
    tangent = _unit(np.gradient(position, station, axis=0))
    lateral = _unit(np.cross([0.0, 0.0, 1.0], tangent))
    wide, high = (_stretch(bore, axis, move) for axis in (bore.lateral, bore.up))
    radius = bore.radius * np.hypot(np.cos(bore.angle) * wide[:, None], np.sin(bore.angle) * high[:, None])
    pocket = bore.pocket.copy()
    if len(pocket):
        pocket["station"] = np.interp(pocket["station"], bore.station, station)
    return Bore(
        station, position, tangent, lateral, np.cross(tangent, lateral), bore.width * wide, bore.height * high,
        bore.angle, radius, np.interp(bore.ring_station, bore.station, station), pocket,
    )  # fmt: skip


def _stretch(bore: Bore, axis: np.ndarray, move: PointMap) -> np.ndarray:
    ends = [move(bore.position + sign * _ARM * axis) for sign in (-1.0, 1.0)]
    return np.linalg.norm(ends[1] - ends[0], axis=1) / (2.0 * _ARM)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


# The rows: controls and invariances by dose, the faults that windows must notice, those of the ladder.

TABLE = Path(__file__).with_name("controls.csv")
OUT_OF_SCENE = "all but SCN PAR"
QUIET_LIMIT = 2.0  # points that a category named as quiet may move
MONOTONE = -0.9
UNORDERED = ("N20", "N26", "N32", "N34", "N35")  # their doses are kinds, not amounts
GLOBAL_LIMIT = 0.3  # points that an invariance may move the global figure
THINNED_LIMIT = 2.0  # the same of one that leaves out beams
_UNITS: dict[str, Callable[[float], float]] = {"": float, "%": lambda dose: dose / 100.0, "deg": np.radians}


@dataclass(frozen=True)
class Control:
    """Row of the table of controls."""

    id: str  # N01 to N36, which must be noticed, I1 to I7, which must not, or the name of a kind from outside
    corruption: str  # Corruption in words
    faults: dict[float, Fault]  # Faults by dose, in growing severity
    bold: tuple[float, ...]  # Doses that must FAIL
    falls: dict[str, float]  # Points that a category must lose at least at the bold dose
    quiet: tuple[str, ...] = ()  # Categories that may move by at most 2 points
    # Categories to compute; the others keep the base's values, since nothing they read has changed
    evaluated: str = "all"
    limit: float | None = None  # Points that an invariance may move a category; `None` for a fault that must be noticed
    exempt: tuple[str, ...] = ()  # Categories that an invariance may move
    reason: str = ""  # Reason for a difference from the specification; empty where there is none
    kind: str = "negative"  # `negative`, `invariance`, or `outside` for one of a user's own, which decides no verdict


def outside_kinds() -> dict[str, Kind]:
    return {name: kind for name, kind in KINDS.items() if not kind.change.__module__.startswith(__package__)}


def load_controls() -> dict[str, Control]:
    """Return the controls by id, in order: those of the suite, then those from outside."""
    more = {
        name: Control(name, kind.words, {d: Fault(name, d) for d in kind.doses}, kind.doses[-1:], kind.falls,
                      kind="outside")
        for name, kind in outside_kinds().items() if kind.doses
    }  # fmt: skip
    return suite_controls() | more


@cache
def suite_controls() -> dict[str, Control]:
    with TABLE.open(newline="") as file:
        return {row["id"]: _read_control(row) for row in csv.DictReader(file)}


def _read_control(row: dict[str, str]) -> Control:
    doses, kinds, unit = _numbers(row["doses"]), row["kind"].split(), _UNITS[row["unit"]]
    sizes, kinds = _numbers(row["sizes"]) or doses, kinds if len(kinds) == len(doses) else kinds * len(doses)
    faults = {d: Fault(kind, float(unit(s))) for d, kind, s in zip(doses, kinds, sizes, strict=True)}
    falls = {pair.split()[0]: float(pair.split()[1]) for pair in row["falls"].split(";") if pair.strip()}
    limit = float(row["limit"]) if row["limit"] else None
    return Control(
        row["id"], row["corruption"], faults, _numbers(row["bold"]), falls, tuple(row["quiet"].split()),
        row["evaluated"], limit, tuple(row["exempt"].split()), row["reason"],
        "negative" if limit is None else "invariance",
    )  # fmt: skip


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(word) for word in text.split())


def stated_faults(length: float) -> dict[str, Fault]:
    """Return the nine faults that an earlier verdict let pass or must notice, placed in a tunnel of `length` m."""
    middle = 0.5 * length
    return {
        "mirrored left to right": Fault("mirror"),
        "roof 8 cm too low over the last 12 m": Fault("roof", -0.08, length - 12.0, 12.0, np.pi / 2),
        "one wall 10 cm out over 4.5 m": Fault("wall", 0.10, middle - 2.2, 4.5),
        "one wall 15 cm out over 3.5 m": Fault("wall", 0.15, middle - 1.7, 3.5, np.pi),
        "everything 10 cm aside over 3.5 m": Fault("aside", 0.10, middle - 1.7, 3.5),
        "rails floating 3 cm": Fault("rails", 0.03),
        "rails floating 3 cm over 8 m": Fault("rails", 0.03, middle - 4.0, 8.0),
        "everything 15 cm along over 10 m": Fault("along", 0.15, middle - 5.0, 10.0),
        "gauge 6 mm too wide over 10 m": Fault("gauge", 0.006, middle - 5.0, 10.0),
    }


_OUTSIDE_LENGTH = 5.0  # m of a user's own fault on the ladder


def asked_faults() -> dict[str, Fault]:
    """Return the faults of which a size must be noticed, by kind, without a place; then those of users' files."""
    rows = (("wall", 0.05, 5.0), ("roof", 0.05, 5.0), ("aside", 0.05, 5.0), ("gauge", 0.005, 10.0),
            ("along", 0.15, 10.0), ("rails", 0.02, 5.0))  # fmt: skip
    more = ((name, kind.doses[-1], _OUTSIDE_LENGTH) for name, kind in outside_kinds().items() if kind.doses)
    return {kind: Fault(kind, size, None, length) for kind, size, length in (*rows, *more)}
