"""Local faults: kinds of corruption with a place, a length and a size, drawn at random or stated."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from benchmarks.fidelity.candidate import Candidate, concatenate_meshes
from benchmarks.fidelity.controls.assets import place_box
from benchmarks.fidelity.controls.shape import axis_of, find_bodies, without_faces
from benchmarks.fidelity.derive.curve import Curve

RAMP = 0.5  # m before and after a fault over which it grows
LENGTHS = (3.0, 12.0)  # m, of faults that are drawn
_SQUEEZE = 3.0  # m before and after what moves along the tunnel
_RAIL_EDGE = 0.5  # m
_EDGE = 1.0  # m that a drawn fault keeps from the mouths
_CORE, _RIM = np.deg2rad(40.0), np.deg2rad(65.0)  # from the middle of a part of the section: fully moved, not moved
_MESHES = ("lining", "solid", "nails", "bed", "extra")
_TRACK = ("sleeper_mesh", "rail_mesh", "fastening_mesh")

Points = Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class Fault:
    """One local fault.

    Attributes:
        kind: Name in `KINDS`.
        start: Station where it is first at full size, m.
        length: Length at full size, m.
        size: Size in the unit of its kind; a sign tells the direction.
        side: Angle of the part of the section that it is at, from left towards up, rad; kinds that have none ignore it.
    """

    kind: str
    start: float
    length: float
    size: float
    side: float = 0.0

    def share(self, station: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return 1 along the fault, 0 beyond its ramps, smooth between."""
        beyond = np.maximum(np.maximum(self.start - station, station - self.start - self.length), 0.0)
        return _smooth(1.0 - beyond / RAMP)

    def extent(self) -> tuple[float, float]:
        """Return the stations beyond which nothing is changed, m; a mirror changes everything."""
        wide = {"along": _SQUEEZE + abs(self.size), "sleepers": RAMP + abs(self.size) + 0.3, "missing": RAMP + 0.3}
        reach = wide.get(self.kind, RAMP)
        return self.start - reach, self.start + self.length + reach


@dataclass(frozen=True)
class Ground:
    """A candidate with the station, left and up of all its vertices, computed once for many faults."""

    candidate: Candidate

    @cached_property
    def line(self) -> Curve:
        """Axis of the candidate."""
        return axis_of(self.candidate)

    @cached_property
    def local(self) -> dict[str, Points]:
        """Station, left and up of the vertices, by mesh, m."""
        return {name: self.line.local(np.asarray(mesh.vertices, float)) for name, mesh in self.meshes().items()}

    def meshes(self) -> dict[str, trimesh.Trimesh]:
        """Return the meshes of the candidate that are not empty, by name."""
        one, track = self.candidate, self.candidate.track
        every = {name: getattr(one, name) for name in _MESHES} | {name: getattr(track, name) for name in _TRACK}
        return {name: mesh for name, mesh in every.items() if len(mesh.faces)}

    def moved(self, shift: Callable[[Points], Points], only: tuple[str, ...] | None = None) -> Candidate:
        """Return the candidate with its vertices moved by `shift` of their station, left and up.

        Args:
            shift: Function from station, left and up to what is added to them; 0 leaves a vertex exactly alone.
            only: Meshes to move, and `rail` and `sleeper` for their points; all where `None`.
        """
        changed: dict[str, Any] = {
            name: trimesh.Trimesh(self._move(np.asarray(mesh.vertices, float), self.local[name], shift), mesh.faces,
                                  process=False)
            for name, mesh in self.meshes().items() if only is None or name in only
        }  # fmt: skip
        track = replace(self.candidate.track, **{name: changed[name] for name in _TRACK if name in changed})
        if only is None or "rail" in only:
            track = replace(track, rail={side: self._points(top, shift) for side, top in track.rail.items()})
        if only is None or "sleeper" in only:
            track = replace(track, sleeper=self._points(track.sleeper, shift))
        return replace(self.candidate, track=track, **{name: changed[name] for name in _MESHES if name in changed})

    def _points(self, points: Points, shift: Callable[[Points], Points]) -> Points:
        return self._move(points, self.line.local(points), shift) if len(points) else points

    def _move(self, points: Points, local: Points, shift: Callable[[Points], Points]) -> Points:
        by = shift(local)
        rows = np.flatnonzero(np.abs(by).max(axis=1) > 0.0) if len(by) else np.empty(0, int)
        result = points.copy()
        result[rows] = self.line.point(local[rows] + by[rows])
        return result


def make_ground(candidate: Candidate) -> Ground:
    """Return the ground of faults in a candidate; its rails, boxes of some metres, are cut into short ones first."""
    track = candidate.track
    if not len(track.rail_mesh.faces):
        return Ground(candidate)
    line = axis_of(candidate)
    fine = trimesh.remesh.subdivide_to_size(track.rail_mesh.vertices, track.rail_mesh.faces, _RAIL_EDGE, max_iter=20)
    rail = {side: _denser(points, line) for side, points in track.rail.items()}
    return Ground(replace(candidate, track=replace(
        track, rail_mesh=trimesh.Trimesh(fine[0], fine[1], process=False), rail=rail,
    )))  # fmt: skip


def _denser(points: Points, line: Curve) -> Points:
    """Return points every `_RAIL_EDGE` along a line of points, m."""
    if len(points) < 2:
        return points
    station = line.local(points)[:, 0]
    order = np.argsort(station, kind="stable")
    at = np.union1d(station, np.arange(station.min(), station.max(), _RAIL_EDGE))
    return np.column_stack([np.interp(at, station[order], axis) for axis in points[order].T])


def _smooth(value: np.ndarray) -> np.ndarray:
    inside = np.clip(value, 0.0, 1.0)
    return inside**2 * (3.0 - 2.0 * inside)


def _near_side(local: Points, side: float) -> Float[np.ndarray, " n"]:
    """Return 1 for vertices about an angle of the section, 0 far from it."""
    away = np.abs(np.angle(np.exp(1j * (np.arctan2(local[:, 2], local[:, 1]) - side))))
    return _smooth((_RIM - away) / (_RIM - _CORE))


def _columns(local: Points, axis: int, values: np.ndarray) -> Points:
    by = np.zeros_like(local)
    by[:, axis] = values
    return by


WALLS = ("lining", "solid", "nails")
RAILS = ("rail_mesh", "fastening_mesh", "rail")


def _bulge(ground: Ground, fault: Fault) -> Candidate:
    way = np.array([np.cos(fault.side), np.sin(fault.side)])

    def shift(local: Points) -> Points:
        weight = fault.size * fault.share(local[:, 0]) * _near_side(local, fault.side)
        return np.column_stack([np.zeros(len(local)), weight[:, None] * way])

    return ground.moved(shift, WALLS)


def _raise_floor(ground: Ground, fault: Fault) -> Candidate:
    down = replace(fault, side=-np.pi / 2)

    def shift(local: Points) -> Points:
        return _columns(local, 2, fault.size * fault.share(local[:, 0]) * _near_side(local, down.side))

    return ground.moved(shift, (*WALLS, "bed", *_TRACK, "rail", "sleeper"))


def _move_all(axis: int) -> Callable[[Ground, Fault], Candidate]:
    return lambda ground, fault: ground.moved(
        lambda local: _columns(local, axis, fault.size * fault.share(local[:, 0]))
    )


def _stretch(ground: Ground, fault: Fault) -> Candidate:
    """Moves everything along the tunnel; before and behind it is squeezed and stretched over `_SQUEEZE`."""
    end = fault.start + fault.length
    stations = [fault.start - _SQUEEZE, fault.start, end, end + _SQUEEZE]

    def shift(local: Points) -> Points:
        return _columns(local, 0, fault.size * np.interp(local[:, 0], stations, [0.0, 1.0, 1.0, 0.0]))

    return ground.moved(shift)


def _spread_rails(ground: Ground, fault: Fault) -> Candidate:
    track = ground.candidate.track
    middle = float(np.mean([ground.line.local(top)[:, 1].mean() for top in track.rail.values()]))

    def shift(local: Points) -> Points:
        return _columns(local, 1, 0.5 * fault.size * fault.share(local[:, 0]) * np.sign(local[:, 1] - middle))

    return ground.moved(shift, RAILS)


def _lift_rails(ground: Ground, fault: Fault) -> Candidate:
    return ground.moved(lambda local: _columns(local, 2, fault.size * fault.share(local[:, 0])), RAILS)


def _move_track(ground: Ground, fault: Fault) -> Candidate:
    return ground.moved(
        lambda local: _columns(local, 1, fault.size * fault.share(local[:, 0])), (*_TRACK, "rail", "sleeper")
    )


def _roll(ground: Ground, fault: Fault) -> Candidate:
    def shift(local: Points) -> Points:
        turn = fault.size * fault.share(local[:, 0])
        left = local[:, 1] * np.cos(turn) - local[:, 2] * np.sin(turn)
        up = local[:, 1] * np.sin(turn) + local[:, 2] * np.cos(turn)
        return np.column_stack([np.zeros(len(local)), left - local[:, 1], up - local[:, 2]])

    return ground.moved(shift)


def _shift_sleepers(ground: Ground, fault: Fault) -> Candidate:
    """Moves sleepers with their fastenings along the track, each as a whole."""
    track, line = ground.candidate.track, ground.line
    meshes: dict[str, Any] = {}
    for name in ("sleeper_mesh", "fastening_mesh"):
        mesh = getattr(track, name)
        label, middle = find_bodies(mesh)
        by = fault.size * (fault.share(line.local(middle)[:, 0]) > 0.5) if len(middle) else np.zeros(0)
        tangent = line.frames(line.local(middle)[:, 0])[1] if len(middle) else np.zeros((0, 3))
        meshes[name] = trimesh.Trimesh(mesh.vertices + (by[:, None] * tangent)[label], mesh.faces, process=False)
    return replace(ground.candidate, track=replace(track, **meshes))


def _drop_sleepers(ground: Ground, fault: Fault) -> Candidate:
    """Removes a share of the sleepers, evenly spread, with their fastenings."""
    track, line = ground.candidate.track, ground.line
    station = line.local(track.sleeper)[:, 0]
    inside = np.flatnonzero(fault.share(station) > 0.5)
    gone = inside[np.floor(np.arange(1, len(inside) + 1) * fault.size) > np.floor(np.arange(len(inside)) * fault.size)]
    away = np.sort(station[gone])

    def rest(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        if not len(mesh.faces) or not len(away):
            return mesh
        label, middle = find_bodies(mesh)
        near = np.abs(line.local(middle)[:, :1] - away[None]).min(axis=1) < 0.25
        return without_faces(mesh, near[label[mesh.faces[:, 0]]])

    kept = np.setdiff1d(np.arange(len(station)), gone)
    return replace(ground.candidate, track=replace(
        track, sleeper=track.sleeper[kept], sleeper_mesh=rest(track.sleeper_mesh),
        fastening_mesh=rest(track.fastening_mesh),
    ))  # fmt: skip


def _fill_pockets(ground: Ground, fault: Fault) -> Candidate:
    """Takes a share of their depth from all pockets along the fault; nails stay."""
    bore = ground.candidate.bore
    smooth = np.median(bore.radius, axis=0)

    def shift(local: Points) -> Points:
        radius, angle = np.hypot(local[:, 1], local[:, 2]), np.arctan2(local[:, 2], local[:, 1])
        row = np.clip(np.searchsorted(bore.station, local[:, 0]), 0, len(bore.station) - 1)
        step = 2.0 * np.pi / len(bore.angle)
        column = np.round((angle - bore.angle[0]) / step).astype(int) % len(bore.angle)
        depth = radius - np.where(np.isfinite(bore.radius[row, column]), bore.radius[row, column], smooth[column])
        deep = np.where((depth > 0.03) & (depth < 0.25), depth, 0.0) * fault.size * fault.share(local[:, 0])
        scale = -deep / np.maximum(radius, 1e-9)
        return np.column_stack([np.zeros(len(local)), local[:, 1] * scale, local[:, 2] * scale])

    return ground.moved(shift, ("lining", "solid"))


def _add_box(ground: Ground, fault: Fault) -> Candidate:
    """Puts a cube against the wall."""
    one, station = ground.candidate, fault.start + 0.5 * fault.length
    row = int(np.clip(np.searchsorted(one.bore.station, station), 0, len(one.bore.station) - 1))
    column = int(np.argmin(np.abs(np.angle(np.exp(1j * (one.bore.angle - fault.side))))))
    reach = one.bore.radius[row, column] - 0.5 * fault.size
    left, up = reach * np.cos(fault.side), reach * np.sin(fault.side)
    box = place_box(one, station, left, up, (fault.size,) * 3)
    parts = [part for part in (one.extra, box) if len(part.faces)]
    return replace(one, extra=concatenate_meshes(parts))


def _mirror(ground: Ground, fault: Fault) -> Candidate:
    """Exchanges left and right of everything."""
    mirrored = ground.moved(lambda local: _columns(local, 1, -2.0 * local[:, 1]))
    track = mirrored.track
    flipped: dict[str, Any] = {name: _inside_out(getattr(mirrored, name)) for name in _MESHES}
    laid: dict[str, Any] = {name: _inside_out(getattr(track, name)) for name in _TRACK}
    turned = replace(track, rail={"left": track.rail["right"], "right": track.rail["left"]}, **laid)
    return replace(mirrored, track=turned, **flipped)


def _inside_out(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False) if len(mesh.faces) else mesh


@dataclass(frozen=True)
class Kind:
    """A kind of local fault.

    Attributes:
        words: Fault in words.
        unit: Unit of its size: `m`, `rad` or `1` (a share).
        sizes: Range that sizes are drawn from, evenly by their logarithm; none is drawn of a kind without a range.
        change: Function that carries it out.
        signed: True where it goes both ways.
        sides: Angles that `side` is drawn from, rad.
    """

    words: str
    unit: str
    sizes: tuple[float, float] | None
    change: Callable[[Ground, Fault], Candidate]
    signed: bool = True
    sides: tuple[float, ...] = (0.0,)


_SIDES = (0.0, np.pi)
KINDS: dict[str, Kind] = {
    "wall": Kind("one wall in or out", "m", (0.01, 0.15), _bulge, sides=_SIDES),
    "roof": Kind("roof too low or too high", "m", (0.01, 0.15), _bulge, sides=(np.pi / 2,)),
    "floor": Kind("floor with its track too high or too low", "m", (0.01, 0.15), _raise_floor),
    "aside": Kind("everything to one side", "m", (0.01, 0.15), _move_all(1)),
    "lift": Kind("everything up or down", "m", (0.01, 0.15), _move_all(2)),
    "along": Kind("everything along the tunnel", "m", (0.03, 0.35), _stretch),
    "roll": Kind("section turned about its axis", "rad", (0.003, 0.06), _roll),
    "gauge": Kind("gauge too wide or too narrow", "m", (0.001, 0.02), _spread_rails),
    "rails": Kind("rails floating or sunk", "m", (0.004, 0.06), _lift_rails),
    "track": Kind("track to one side of its place", "m", (0.004, 0.06), _move_track),
    "sleepers": Kind("sleepers along the track", "m", (0.02, 0.28), _shift_sleepers),
    "missing": Kind("share of the sleepers missing", "1", (0.1, 1.0), _drop_sleepers, signed=False),
    "pockets": Kind("share of the pockets' depth filled", "1", (0.1, 1.0), _fill_pockets, signed=False),
    "box": Kind("a cube on the wall that is not there", "m", (0.1, 1.0), _add_box, signed=False,
                sides=(0.0, np.pi, np.pi / 4, 3 * np.pi / 4)),
    "mirror": Kind("left and right exchanged", "1", None, _mirror, signed=False),
}  # fmt: skip


def spoil(ground: Ground, fault: Fault) -> Candidate:
    """Return the candidate with one local fault.

    Raises:
        KeyError: No such kind.
    """
    return KINDS[fault.kind].change(ground, fault)


def draw_fault(rng: np.random.Generator, length: float, kind: str | None = None) -> Fault:
    """Draws kind, place, length, size and direction of a fault in a tunnel of `length` m."""
    name = kind or str(rng.choice([name for name, one in KINDS.items() if one.sizes]))
    one = KINDS[name]
    assert one.sizes is not None
    run = float(rng.uniform(LENGTHS[0], min(LENGTHS[1], length - 2.0 * _EDGE)))
    start = float(rng.uniform(_EDGE, length - _EDGE - run))
    low, high = np.log(one.sizes)
    size = float(np.exp(rng.uniform(low, high))) * (float(rng.choice([-1.0, 1.0])) if one.signed else 1.0)
    return Fault(name, start, run, size, float(rng.choice(one.sides)))


def stated_faults(length: float) -> dict[str, Fault]:
    """Return the nine faults that an earlier verdict let pass or must notice, placed in a tunnel of `length` m."""
    middle = 0.5 * length
    return {
        "mirrored left to right": Fault("mirror", 0.0, length, 1.0),
        "roof 8 cm too low over the last 12 m": Fault("roof", length - 12.0, 12.0, -0.08, np.pi / 2),
        "one wall 10 cm out over 4.5 m": Fault("wall", middle - 2.2, 4.5, 0.10, 0.0),
        "one wall 15 cm out over 3.5 m": Fault("wall", middle - 1.7, 3.5, 0.15, np.pi),
        "everything 10 cm aside over 3.5 m": Fault("aside", middle - 1.7, 3.5, 0.10),
        "rails floating 3 cm": Fault("rails", 0.0, length, 0.03),
        "rails floating 3 cm over 8 m": Fault("rails", middle - 4.0, 8.0, 0.03),
        "everything 15 cm along over 10 m": Fault("along", middle - 5.0, 10.0, 0.15),
        "gauge 6 mm too wide over 10 m": Fault("gauge", middle - 5.0, 10.0, 0.006),
    }
