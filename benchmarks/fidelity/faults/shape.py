"""Faults of shape: walls, floor, place, roll, length, curvature; of sleepers, rails, pockets and rings."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.case import Case
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.faults import kinds
from benchmarks.fidelity.faults.mesh import scale_scene
from benchmarks.fidelity.faults.references import bend_recording
from benchmarks.fidelity.meshes import keep_bodies, move_bodies

_CORE, _RIM = np.deg2rad(40.0), np.deg2rad(65.0)  # from the middle of a part of the section: fully moved, not moved
_FLOOR_RISE = (0.5, 1.3)  # m above the floor between which a raised floor fades into the wall
_SQUEEZE = 3.0  # m before and after what moves along the tunnel
_WAVE = 100.0  # m
_SIDES = (0.0, np.pi)


@kinds.fault_kind("wall", "one wall in or out", "m", sides=_SIDES)
@kinds.fault_kind("roof", "roof too low or too high", "m", sides=(np.pi / 2,))
def bulge(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    way = np.array([0.0, np.cos(fault.side), np.sin(fault.side)])

    def push(local: kinds.Points) -> kinds.Points:
        away = np.abs(np.angle(np.exp(1j * (np.arctan2(local[:, 2], local[:, 1]) - fault.side))))
        near = kinds.smooth_step((_RIM - away) / (_RIM - _CORE))
        return (fault.size * fault.weight(local[:, 0]) * near)[:, None] * way

    return site.moved(push, ("lining", "solid", "nails"))


@kinds.fault_kind("floor", "floor with its track too high or too low", "m")
def raise_floor(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    """Moves floor and track up; the walls above 1.3 m stay."""
    bore = site.candidate.bore
    bottom = -0.5 * float(np.median(bore.height))

    def raised(local: kinds.Points) -> kinds.Points:
        fade = np.interp(local[:, 2] - bottom, _FLOOR_RISE, [1.0, 0.0])
        return kinds.along(2, fault.size * fault.weight(local[:, 0]) * fade)

    rise = fault.size * fault.weight(bore.station)
    down = np.where(np.sin(bore.angle) < -0.5, np.sin(bore.angle), 0.0)
    floor = replace(bore, height=bore.height - rise, radius=bore.radius + rise[:, None] * down)
    return replace(site.moved(raised), bore=floor)


def shift(axis: int, parts: tuple[str, ...] = kinds.EVERYTHING) -> Callable[[kinds.Site, kinds.Fault], Candidate]:
    """Return the change that moves parts to the left (axis 1) or up (2)."""
    return lambda site, fault: site.moved(lambda at: kinds.along(axis, fault.size * fault.weight(at[:, 0])), parts)


kinds.fault_kind("aside", "everything to one side", "m")(shift(1))
kinds.fault_kind("lift", "everything up or down", "m")(shift(2))
kinds.fault_kind("rails", "rails floating or sunk", "m")(shift(2, kinds.RAILS))
kinds.fault_kind("track", "track to one side of its place", "m")(shift(1, (*kinds.TRACK, "rail", "sleeper")))


@kinds.fault_kind("along", "everything along the tunnel", "m")
def move_along(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    """Moves everything along the tunnel; before and behind it is squeezed and stretched over `_SQUEEZE`."""
    start = fault.start or 0.0
    stations = [start - _SQUEEZE, start, start + fault.length, start + fault.length + _SQUEEZE]
    return site.moved(lambda local: kinds.along(0, fault.size * np.interp(local[:, 0], stations, [0.0, 1.0, 1.0, 0.0])))


@kinds.fault_kind("roll", "section turned about its axis", "rad")
def roll(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    def turned(local: kinds.Points) -> kinds.Points:
        turn = fault.size * fault.weight(local[:, 0])
        left = local[:, 1] * np.cos(turn) - local[:, 2] * np.sin(turn)
        up = local[:, 1] * np.sin(turn) + local[:, 2] * np.cos(turn)
        return np.column_stack([np.zeros(len(local)), left - local[:, 1], up - local[:, 2]])

    return site.moved(turned)


@kinds.fault_kind("mirror", "left and right exchanged", signed=False)
def mirror(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    mirrored = site.moved(lambda local: kinds.along(1, -2.0 * local[:, 1]))
    track = mirrored.track
    flipped: dict[str, Any] = {name: _inside_out(getattr(mirrored, name)) for name in kinds.MESHES}
    laid: dict[str, Any] = {name: _inside_out(getattr(track, name)) for name in kinds.TRACK}
    turned = replace(track, rail={"left": track.rail["right"], "right": track.rail["left"]}, **laid)
    return replace(mirrored, track=turned, **flipped)


def _inside_out(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False) if len(mesh.faces) else mesh


def scale(*axes: float) -> Callable[[kinds.Site, kinds.Fault], Candidate]:
    """Return the change that scales every section about its axis: 1 for those of station, left and up that grow."""
    return lambda site, fault: site.moved(
        lambda local: fault.size * fault.weight(local[:, 0])[:, None] * local * list(axes)
    )


kinds.fault_kind("section", "sections too large, as a fraction of width and height")(scale(0.0, 1.0, 1.0))
kinds.fault_kind("width", "sections too wide, as a fraction of the width")(scale(0.0, 1.0, 0.0))


@kinds.fault_kind("wave", "a sideways wave of 100 m length", "m")
def add_wave(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    return site.moved(lambda local: kinds.along(1, fault.size * np.sin(2.0 * np.pi * local[:, 0] / _WAVE)))


# All of the tunnel, whatever the place of the fault.


@kinds.fault_kind("scale", "everything too large, as a fraction of its size")
def scale_all(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    """Scales everything about the middle of the axis, the released scene too."""
    middle, factor = site.candidate.bore.position.mean(axis=0), 1.0 + fault.size
    scene = scale_scene(site.candidate, factor, site.scratch)
    moved = kinds.warp(site.candidate, lambda points: middle + factor * (points - middle))
    return replace(moved, folder=scene.folder, scene=scene.scene, tunnel=scene.tunnel)


@kinds.fault_kind("yaw", "everything turned about the vertical through its middle", "rad")
def turn_yaw(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    middle, (c, s) = site.candidate.bore.position.mean(axis=0), (np.cos(fault.size), np.sin(fault.size))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return kinds.warp(site.candidate, lambda points: middle + (points - middle) @ turn.T)


@kinds.fault_kind("straight", "curvature missing, as a fraction of it", signed=False)
def straighten(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    """Moves the axis towards a straight line of the same length and mean direction; 1 leaves no curvature."""
    line = site.line
    chord = line.position[-1] - line.position[0]
    chord /= np.linalg.norm(chord)
    middle = line.station - line.station.mean()
    straight = line.position.mean(axis=0) + middle[:, None] * chord
    target = Curve(line.station, (1.0 - fault.size) * line.position + fault.size * straight)
    return kinds.warp(site.candidate, lambda points: target.point(line.local(points)))


@kinds.fault_kind("stretch", "mesh and recording together too long, as a fraction of the length")
def stretch_axis(site: kinds.Site, fault: kinds.Fault) -> Case:
    """Lengthens reconstruction and recording together, as a drifting odometry does; control stays."""
    case, line, factor = site.case, site.line, 1.0 + fault.size
    middle = line.position.mean(axis=0)
    longer = Curve(line.station * factor, middle + factor * (line.position - middle))

    def move(points: np.ndarray) -> np.ndarray:
        return longer.point(line.local(points) * [factor, 1.0, 1.0])

    hold, fit = (None if one is None else bend_recording(one, move) for one in (case.hold, case.fit))
    return replace(case, candidate=kinds.warp(case.candidate, move), hold=hold, fit=fit, cache={})


@kinds.fault_kind("short", "last part missing, as a fraction of the length", signed=False)
def shorten(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    candidate, line = site.candidate, site.line
    bore, track, end = candidate.bore, candidate.track, candidate.length * (1.0 - fault.size)
    position, tangent, *_ = line.frames(np.array([end]))
    kept = bore.station <= end

    def cut(mesh: trimesh.Trimesh, cap: bool) -> trimesh.Trimesh:
        return trimesh.intersections.slice_mesh_plane(mesh, -tangent[0], position[0], cap=cap, engine="manifold")

    def before(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        return keep_bodies(mesh, lambda middles: line.local(middles)[:, 0] <= end)

    rows = ("station", "position", "tangent", "lateral", "up", "width", "height", "radius")
    short = replace(
        bore, **{name: getattr(bore, name)[kept] for name in rows},
        ring_station=bore.ring_station[bore.ring_station <= end],
        pocket=bore.pocket[bore.pocket["station"] <= end] if len(bore.pocket) else bore.pocket,
    )  # fmt: skip
    rail = {side: points[line.local(points)[:, 0] <= end] for side, points in track.rail.items() if len(points)}
    laid: dict[str, Any] = {name: before(getattr(track, name)) for name in kinds.TRACK}
    if len(track.sleeper):
        laid["sleeper"] = track.sleeper[line.local(track.sleeper)[:, 0] <= end]
    welded = candidate.solid.copy()
    welded.merge_vertices(digits_vertex=6)
    return replace(
        candidate, lining=cut(candidate.lining, False), solid=cut(welded, True), bore=short,
        track=replace(track, rail=rail or track.rail, **laid), nails=before(candidate.nails),
    )  # fmt: skip


# Sleepers, rails, pockets and rings.

_NEAR = 0.3  # m along the track within which a fastening belongs to a sleeper
_MARGIN = 0.03  # m around a pocket's footprint
_AT_REST = 3.0  # m at the mouths over which a shifted pattern comes to rest
_NAIL_ALONG, _NAIL_AROUND = 0.4, 0.1  # m and rad between a nail and a pocket that it reaches into
_LEFT_DEPTH = 5e-4  # m that a removed pocket keeps, so that its sides do not vanish
_PITCH = 1.5  # m between joints where none is known


@kinds.fault_kind("gauge", "gauge too wide or too narrow", "m")
def spread_rails(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    tops = [site.line.local(top)[:, 1].mean() for top in site.candidate.track.rail.values() if len(top)]
    middle = float(np.mean(tops))

    def shift(local: kinds.Points) -> kinds.Points:
        return kinds.along(1, 0.5 * fault.size * fault.weight(local[:, 0]) * np.sign(local[:, 1] - middle))

    return site.moved(shift, kinds.RAILS)


@kinds.fault_kind("sleepers", "sleepers along the track", "m")
def shift_sleepers(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    """Moves sleepers with their fastenings along the track, each as a whole."""

    def shift(middles: np.ndarray) -> np.ndarray:
        station = site.line.local(middles)[:, 0]
        return fault.size * (fault.weight(station) > 0.5)[:, None] * site.line.frames(station)[1]

    track, names = site.candidate.track, ("sleeper_mesh", "fastening_mesh")
    meshes: dict[str, Any] = {name: move_bodies(getattr(track, name), shift) for name in names}
    return replace(site.candidate, track=replace(track, **meshes))


@kinds.fault_kind("spacing", "sleepers at another spacing", "m", signed=False)
def respace_sleepers(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    """Moves sleepers to a spacing from the first one on; those beyond the end are removed."""
    track, line = site.candidate.track, site.line
    old = line.local(track.sleeper)[:, 0]
    factor = fault.size / float(np.median(np.diff(old)))

    def shift(middles: np.ndarray) -> np.ndarray:
        local = line.local(middles)
        nearest = old[np.argmin(np.abs(local[:, :1] - old[None]), axis=1)]
        local[:, 0] += old[0] + factor * (nearest - old[0]) - nearest
        return line.point(local) - middles

    def inside(middles: np.ndarray) -> np.ndarray:
        return line.local(middles)[:, 0] < site.candidate.length - 0.1

    sleeper = track.sleeper + shift(track.sleeper)
    return replace(site.candidate, track=replace(
        track, sleeper=sleeper[inside(sleeper)],
        sleeper_mesh=keep_bodies(move_bodies(track.sleeper_mesh, shift), inside),
        fastening_mesh=keep_bodies(move_bodies(track.fastening_mesh, shift), inside),
    ))  # fmt: skip


@kinds.fault_kind("missing", "fraction of the sleepers missing", signed=False)
def drop_sleepers(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    """Removes a fraction of the sleepers along the fault, evenly spread, with their fastenings."""
    track, line = site.candidate.track, site.line
    station = line.local(track.sleeper)[:, 0]
    inside = np.flatnonzero(fault.weight(station) > 0.5)
    gone = inside[np.floor(np.arange(1, len(inside) + 1) * fault.size) > np.floor(np.arange(len(inside)) * fault.size)]

    def stays(middles: np.ndarray) -> np.ndarray:
        return np.abs(line.local(middles)[:, :1] - station[gone]).min(axis=1, initial=np.inf) > _NEAR

    return replace(site.candidate, track=replace(
        track, sleeper=np.delete(track.sleeper, gone, axis=0), sleeper_mesh=keep_bodies(track.sleeper_mesh, stays),
        fastening_mesh=keep_bodies(track.fastening_mesh, stays),
    ))  # fmt: skip


@kinds.fault_kind("pockets", "fraction of the pockets' depth filled; below 0 they are too deep")
def fill_pockets(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    """Takes a fraction of their depth from the pockets along the fault; 1 closes them and removes the nails in them."""
    candidate, bore, line, factor = site.candidate, site.candidate.bore, site.line, 1.0 - fault.size
    if not len(bore.pocket):
        return candidate
    chosen = fault.weight(bore.pocket["station"]) > 0.5
    pockets = bore.pocket[chosen]

    def changed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        local = line.local(mesh.vertices)
        radius, angle = np.hypot(local[:, 1], local[:, 2]), np.arctan2(local[:, 2], local[:, 1])
        smooth = _smooth_radius(candidate, local[:, 0], angle)
        excess = radius - smooth
        inside = (excess > 0.02) & _in_pockets(pockets, local[:, 0], angle, smooth)
        target = smooth + np.maximum(factor * excess, _LEFT_DEPTH)
        grown = np.where(inside, target / np.maximum(radius, 1e-9), 1.0)
        vertices = mesh.vertices.copy()
        vertices[inside] = line.point(local * np.column_stack([np.ones(len(local)), grown, grown]))[inside]
        return trimesh.Trimesh(vertices, mesh.faces, process=False)

    pocket = bore.pocket.copy()
    pocket["depth"][chosen] *= factor
    closed = factor <= 0.0
    return replace(
        candidate, lining=changed(candidate.lining), solid=changed(candidate.solid),
        bore=replace(bore, pocket=pocket[~chosen] if closed else pocket),
        nails=keep_bodies(candidate.nails, _outside_pockets(pockets, line)) if closed else candidate.nails,
    )  # fmt: skip


@kinds.fault_kind("pattern", "pockets and joints along the tunnel, in pitches of the rings")
def shift_pattern(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    """Shifts pockets and joints along the tunnel; mouths and track stay."""
    candidate, bore = site.candidate, site.candidate.bore
    joints = bore.ring_station
    by = fault.size * (float(np.median(np.diff(joints))) if len(joints) > 2 else _PITCH)

    def shifted(station: np.ndarray) -> np.ndarray:
        fade = np.interp(station, [0.0, _AT_REST, candidate.length - _AT_REST, candidate.length], [0.0, 1.0, 1.0, 0.0])
        return station + by * fade

    pocket = bore.pocket.copy()
    pocket["station"] = shifted(pocket["station"])
    moved = site.moved(lambda local: kinds.along(0, shifted(local[:, 0]) - local[:, 0]), ("lining", "solid", "nails"))
    return replace(moved, bore=replace(bore, pocket=pocket, ring_station=shifted(joints)))


def _smooth_radius(candidate: Candidate, station: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the radius of the bore without pockets at stations and angles, m."""
    bore = candidate.bore
    row = np.clip(np.searchsorted(bore.station, station), 1, len(bore.station) - 1)
    step = (angle - bore.angle[0]) / (bore.angle[1] - bore.angle[0])
    low, fraction = np.floor(step).astype(int) % len(bore.angle), step - np.floor(step)
    ahead = (station - bore.station[row - 1]) / (bore.station[row] - bore.station[row - 1])
    ahead = np.clip(ahead, 0.0, 1.0)
    high = (low + 1) % len(bore.angle)
    before, after = (bore.radius[r, low] * (1 - fraction) + bore.radius[r, high] * fraction for r in (row - 1, row))
    return (1 - ahead) * before + ahead * after


def _in_pockets(pocket: np.ndarray, station: np.ndarray, angle: np.ndarray, radius: np.ndarray) -> np.ndarray:
    inside = np.zeros(len(station), bool)
    order = np.argsort(station)
    for one in pocket:
        reach = 0.5 * one["length"] + _MARGIN
        part = order[slice(*np.searchsorted(station[order], [one["station"] - reach, one["station"] + reach]))]
        turn = (angle[part] - one["angle"] + np.pi) % (2.0 * np.pi) - np.pi
        inside[part] |= np.abs(turn) * radius[part] < 0.5 * one["width"] + 3 * _MARGIN
    return inside


def _outside_pockets(pocket: np.ndarray, line: Curve) -> Callable[[np.ndarray], np.ndarray]:
    """Return a test whether bodies lie farther from every pocket than a nail reaches."""

    def away(middles: np.ndarray) -> np.ndarray:
        local = line.local(middles)
        near = np.abs(local[:, :1] - pocket["station"][None]) < _NAIL_ALONG
        turn = np.arctan2(local[:, 2:], local[:, 1:2]) - pocket["angle"][None]
        return ~(near & (np.abs((turn + np.pi) % (2.0 * np.pi) - np.pi) < _NAIL_AROUND)).any(axis=1)

    return away
