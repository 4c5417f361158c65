"""A fault as one row, the kinds of faults, and the site that they are put into."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float

from benchmarks.fidelity.candidate import Bore, Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.files import FidelityError

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

    def share(self, station: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
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
    unit: str  # Unit of its size: `m`, `rad`, `1` (a share or factor) or `count`
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
        FidelityError: The name is taken.
    """
    if name in KINDS:
        raise FidelityError(f"fault {name!r}: this kind is registered twice")

    def register(change: Callable) -> Callable:
        KINDS[name] = Kind(words, unit, change, **more)  # type: ignore[arg-type]
        return change

    return register


def put_in(site: Site, fault: Fault) -> Case:
    """Return the case with one fault; nothing computed of the case as it is stays with it.

    Raises:
        KeyError: No such kind.
    """
    changed = KINDS[fault.kind].change(site, fault)
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
