"""Faults of sleepers, rails, pockets and rings."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh

from benchmarks.fidelity.candidate import Candidate
from benchmarks.fidelity.derive.curve import Curve
from benchmarks.fidelity.faults.kinds import RAILS, TRACK, Fault, Points, Site, along, fault_kind
from benchmarks.fidelity.meshes import keep_bodies, move_bodies

_NEAR = 0.3  # m along the track within which a fastening belongs to a sleeper
_MARGIN = 0.03  # m around a pocket's footprint
_RAMP = 3.0  # m at the mouths over which a shifted pattern comes to rest
_NAIL_ALONG, _NAIL_AROUND = 0.4, 0.1  # m and rad between a nail and a pocket that it reaches into
_LEFT_DEPTH = 5e-4  # m that a removed pocket keeps, so that its sides do not vanish
_PITCH = 1.5  # m between joints where none is known


@fault_kind("gauge", "gauge too wide or too narrow", "m")
def spread_rails(site: Site, fault: Fault) -> Candidate:
    tops = [site.line.local(top)[:, 1].mean() for top in site.candidate.track.rail.values() if len(top)]
    middle = float(np.mean(tops))

    def shift(local: Points) -> Points:
        return along(1, 0.5 * fault.size * fault.share(local[:, 0]) * np.sign(local[:, 1] - middle))

    return site.moved(shift, RAILS)


@fault_kind("sleepers", "sleepers along the track", "m")
def shift_sleepers(site: Site, fault: Fault) -> Candidate:
    """Moves sleepers with their fastenings along the track, each as a whole."""

    def shift(middles: np.ndarray) -> np.ndarray:
        station = site.line.local(middles)[:, 0]
        return fault.size * (fault.share(station) > 0.5)[:, None] * site.line.frames(station)[1]

    track = site.candidate.track
    meshes: dict[str, Any] = {name: move_bodies(getattr(track, name), shift) for name in TRACK if name != "rail_mesh"}
    return replace(site.candidate, track=replace(track, **meshes))


@fault_kind("spacing", "sleepers at another spacing", "m", signed=False)
def respace_sleepers(site: Site, fault: Fault) -> Candidate:
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


@fault_kind("missing", "share of the sleepers missing", signed=False)
def drop_sleepers(site: Site, fault: Fault) -> Candidate:
    """Removes a share of the sleepers along the fault, evenly spread, with their fastenings."""
    track, line = site.candidate.track, site.line
    station = line.local(track.sleeper)[:, 0]
    inside = np.flatnonzero(fault.share(station) > 0.5)
    gone = inside[np.floor(np.arange(1, len(inside) + 1) * fault.size) > np.floor(np.arange(len(inside)) * fault.size)]

    def stays(middles: np.ndarray) -> np.ndarray:
        return np.abs(line.local(middles)[:, :1] - station[gone]).min(axis=1, initial=np.inf) > _NEAR

    return replace(site.candidate, track=replace(
        track, sleeper=np.delete(track.sleeper, gone, axis=0), sleeper_mesh=keep_bodies(track.sleeper_mesh, stays),
        fastening_mesh=keep_bodies(track.fastening_mesh, stays),
    ))  # fmt: skip


@fault_kind("pockets", "share of the pockets' depth filled; below 0 they are too deep")
def fill_pockets(site: Site, fault: Fault) -> Candidate:
    """Takes a share of their depth from the pockets along the fault; 1 closes them and removes the nails in them."""
    candidate, bore, line, factor = site.candidate, site.candidate.bore, site.line, 1.0 - fault.size
    if not len(bore.pocket):
        return candidate
    chosen = fault.share(bore.pocket["station"]) > 0.5
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


@fault_kind("pattern", "pockets and joints along the tunnel, in pitches of the rings")
def shift_pattern(site: Site, fault: Fault) -> Candidate:
    """Shifts pockets and joints along the tunnel; mouths and track stay."""
    candidate, bore = site.candidate, site.candidate.bore
    joints = bore.ring_station
    by = fault.size * (float(np.median(np.diff(joints))) if len(joints) > 2 else _PITCH)

    def shifted(station: np.ndarray) -> np.ndarray:
        fade = np.interp(station, [0.0, _RAMP, candidate.length - _RAMP, candidate.length], [0.0, 1.0, 1.0, 0.0])
        return station + by * fade

    pocket = bore.pocket.copy()
    pocket["station"] = shifted(pocket["station"])
    moved = site.moved(lambda local: along(0, shifted(local[:, 0]) - local[:, 0]), ("lining", "solid", "nails"))
    return replace(moved, bore=replace(bore, pocket=pocket, ring_station=shifted(joints)))


def _smooth_radius(candidate: Candidate, station: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the radius of the bore without pockets at stations and angles, m."""
    bore = candidate.bore
    row = np.clip(np.searchsorted(bore.station, station), 1, len(bore.station) - 1)
    step = (angle - bore.angle[0]) / (bore.angle[1] - bore.angle[0])
    low, share = np.floor(step).astype(int) % len(bore.angle), step - np.floor(step)
    ahead = (station - bore.station[row - 1]) / (bore.station[row] - bore.station[row - 1])
    ahead = np.clip(ahead, 0.0, 1.0)
    high = (low + 1) % len(bore.angle)
    before, after = (bore.radius[r, low] * (1 - share) + bore.radius[r, high] * share for r in (row - 1, row))
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
