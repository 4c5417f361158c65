"""Faults of size and shape: walls, floor, place, roll, length, curvature."""

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
from benchmarks.fidelity.meshes import keep_bodies

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
        return (fault.size * fault.share(local[:, 0]) * near)[:, None] * way

    return site.moved(push, ("lining", "solid", "nails"))


@kinds.fault_kind("floor", "floor with its track too high or too low", "m")
def raise_floor(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    """Moves floor and track up; the walls above 1.3 m stay."""
    bore = site.candidate.bore
    bottom = -0.5 * float(np.median(bore.height))

    def raised(local: kinds.Points) -> kinds.Points:
        fade = np.interp(local[:, 2] - bottom, _FLOOR_RISE, [1.0, 0.0])
        return kinds.along(2, fault.size * fault.share(local[:, 0]) * fade)

    rise = fault.size * fault.share(bore.station)
    down = np.where(np.sin(bore.angle) < -0.5, np.sin(bore.angle), 0.0)
    floor = replace(bore, height=bore.height - rise, radius=bore.radius + rise[:, None] * down)
    return replace(site.moved(raised), bore=floor)


def shift(axis: int, parts: tuple[str, ...] = kinds.EVERYTHING) -> Callable[[kinds.Site, kinds.Fault], Candidate]:
    """Return the change that moves parts to the left (axis 1) or up (2)."""
    return lambda site, fault: site.moved(lambda local: kinds.along(axis, fault.size * fault.share(local[:, 0])), parts)


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
        turn = fault.size * fault.share(local[:, 0])
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
        lambda local: fault.size * fault.share(local[:, 0])[:, None] * local * list(axes)
    )


kinds.fault_kind("section", "sections too large, as a share of width and height")(scale(0.0, 1.0, 1.0))
kinds.fault_kind("width", "sections too wide, as a share of the width")(scale(0.0, 1.0, 0.0))


@kinds.fault_kind("wave", "a sideways wave of 100 m length", "m")
def add_wave(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    return site.moved(lambda local: kinds.along(1, fault.size * np.sin(2.0 * np.pi * local[:, 0] / _WAVE)))


# All of the tunnel, whatever the place of the fault.


@kinds.fault_kind("scale", "everything too large, as a share of its size")
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


@kinds.fault_kind("straight", "curvature missing, as a share of it", signed=False)
def straighten(site: kinds.Site, fault: kinds.Fault) -> Candidate:
    """Moves the axis towards a straight line of the same length and mean direction; 1 leaves no curvature."""
    line = site.line
    chord = line.position[-1] - line.position[0]
    chord /= np.linalg.norm(chord)
    middle = line.station - line.station.mean()
    straight = line.position.mean(axis=0) + middle[:, None] * chord
    target = Curve(line.station, (1.0 - fault.size) * line.position + fault.size * straight)
    return kinds.warp(site.candidate, lambda points: target.point(line.local(points)))


@kinds.fault_kind("stretch", "mesh and recording together too long, as a share of the length")
def stretch_axis(site: kinds.Site, fault: kinds.Fault) -> Case:
    """Lengthens reconstruction and recording together, as a drifting odometry does; control stays."""
    case, line, factor = site.case, site.line, 1.0 + fault.size
    middle = line.position.mean(axis=0)
    longer = Curve(line.station * factor, middle + factor * (line.position - middle))

    def move(points: np.ndarray) -> np.ndarray:
        return longer.point(line.local(points) * [factor, 1.0, 1.0])

    hold, fit = (None if one is None else bend_recording(one, move) for one in (case.hold, case.fit))
    return replace(case, candidate=kinds.warp(case.candidate, move), hold=hold, fit=fit, cache={})


@kinds.fault_kind("short", "last part missing, as a share of the length", signed=False)
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
