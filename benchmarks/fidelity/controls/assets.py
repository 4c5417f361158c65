"""Controls of sleepers, rails and pockets, and of bodies that stand in the bore."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import trimesh

from benchmarks.fidelity.candidate import Candidate, Track, concatenate_meshes
from benchmarks.fidelity.controls.shape import axis_of, keep_bodies, move_bodies, warp_mesh
from benchmarks.fidelity.derive.curve import Curve

_NEAR = 0.3  # m along the track within which a fastening belongs to a sleeper
_MARGIN = 0.03  # m around a pocket's footprint
_RAMP = 3.0  # m at the mouths over which a shifted pattern comes to rest
_NAIL_ALONG, _NAIL_AROUND = 0.4, 0.1  # m and rad between a nail and a pocket that it reaches into
_LEFT_DEPTH = 5e-4  # m that a removed pocket keeps, so that its sides do not vanish


def remove_sleepers(candidate: Candidate, share: float, rng: np.random.Generator) -> Candidate:
    """Removes a share of the sleepers with their fastenings."""
    track, line = candidate.track, axis_of(candidate)
    count = len(track.sleeper)
    gone = rng.permutation(count)[: round(share * count)]
    away = np.sort(line.local(track.sleeper[gone])[:, 0])

    def stays(middles: np.ndarray) -> np.ndarray:
        return _nearest_gap(line.local(middles)[:, 0], away) > _NEAR

    kept = np.setdiff1d(np.arange(count), gone)
    return replace(candidate, track=replace(
        track, sleeper=track.sleeper[kept], sleeper_mesh=keep_bodies(track.sleeper_mesh, stays),
        fastening_mesh=keep_bodies(track.fastening_mesh, stays),
    ))  # fmt: skip


def respace_sleepers(candidate: Candidate, spacing: float) -> Candidate:
    """Moves sleepers to another spacing from the first one on; those beyond the end are removed."""
    track, line = candidate.track, axis_of(candidate)
    old = line.local(track.sleeper)[:, 0]
    factor = spacing / float(np.median(np.diff(old)))

    def target(station: np.ndarray) -> np.ndarray:
        nearest = old[np.argmin(np.abs(station[:, None] - old[None]), axis=1)]
        return station - nearest + old[0] + factor * (nearest - old[0])

    def shift(middles: np.ndarray) -> np.ndarray:
        local = line.local(middles)
        return line.point(np.column_stack([target(local[:, 0]), local[:, 1:]])) - middles

    def inside(middles: np.ndarray) -> np.ndarray:
        return line.local(middles)[:, 0] < candidate.length - 0.1

    sleeper = track.sleeper + shift(track.sleeper)
    return replace(candidate, track=replace(
        track, sleeper=sleeper[inside(sleeper)],
        sleeper_mesh=keep_bodies(move_bodies(track.sleeper_mesh, shift), inside),
        fastening_mesh=keep_bodies(move_bodies(track.fastening_mesh, shift), inside),
    ))  # fmt: skip


def change_gauge(candidate: Candidate, gauge: float) -> Candidate:
    """Moves rails and fastenings apart or together, half on each side, to a gauge in m."""
    track, line = candidate.track, axis_of(candidate)
    middle = np.mean([line.local(points)[:, 1].mean() for points in track.rail.values() if len(points)])
    aside = 0.5 * (gauge - (track.gauge or gauge))

    def move(points: np.ndarray) -> np.ndarray:
        local = line.local(points)
        local[:, 1] += aside * np.sign(local[:, 1] - middle)
        return line.point(local)

    return replace(candidate, track=Track(
        track.sleeper, track.sleeper_mesh, {side: move(points) for side, points in track.rail.items()},
        warp_mesh(track.rail_mesh, move), warp_mesh(track.fastening_mesh, move), gauge,
    ))  # fmt: skip


def scale_pockets(candidate: Candidate, factor: float, share: float, rng: np.random.Generator) -> Candidate:
    """Multiplies the depth of a share of the pockets; 0 closes them and removes the nails in them."""
    bore = candidate.bore
    if not len(bore.pocket):
        return candidate
    pick = rng.permutation(len(bore.pocket))[: round(share * len(bore.pocket))]
    pockets = bore.pocket[pick]
    line = axis_of(candidate)

    def deeper(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        local = line.local(mesh.vertices)
        radius, angle = np.hypot(local[:, 1], local[:, 2]), np.arctan2(local[:, 2], local[:, 1])
        smooth = _smooth_radius(candidate, local[:, 0], angle)
        excess = radius - smooth
        inside = (excess > 0.02) & _in_pockets(pockets, local[:, 0], angle, smooth)
        deeper_radius = smooth + np.maximum(factor * excess, _LEFT_DEPTH)
        grown = np.where(inside, deeper_radius / np.maximum(radius, 1e-9), 1.0)
        vertices = mesh.vertices.copy()
        vertices[inside] = line.point(local * np.column_stack([np.ones(len(local)), grown, grown]))[inside]
        return trimesh.Trimesh(vertices, mesh.faces, process=False)

    pocket = bore.pocket.copy()
    pocket["depth"][pick] *= factor
    if not factor:
        pocket = np.delete(pocket, pick)
    nails = candidate.nails if factor else keep_bodies(candidate.nails, _outside_pockets(pockets, line))
    return replace(
        candidate, lining=deeper(candidate.lining), solid=deeper(candidate.solid),
        bore=replace(bore, pocket=pocket), nails=nails,
    )  # fmt: skip


def shift_pattern(candidate: Candidate, shift: float) -> Candidate:
    """Shifts pockets and joints along the tunnel by some metres; mouths and track stay."""
    bore, line = candidate.bore, axis_of(candidate)

    def target(station: np.ndarray) -> np.ndarray:
        fade = np.interp(station, [0.0, _RAMP, candidate.length - _RAMP, candidate.length], [0.0, 1.0, 1.0, 0.0])
        return station + shift * fade

    def move(points: np.ndarray) -> np.ndarray:
        local = line.local(points)
        local[:, 0] = target(local[:, 0])
        return line.point(local)

    pocket = bore.pocket.copy()
    pocket["station"] = target(pocket["station"])
    return replace(
        candidate, lining=warp_mesh(candidate.lining, move), solid=warp_mesh(candidate.solid, move),
        bore=replace(bore, pocket=pocket, ring_station=target(bore.ring_station)),
        nails=warp_mesh(candidate.nails, move),
    )  # fmt: skip


def ring_pitch(candidate: Candidate) -> float:
    """Return the median distance of the ring joints, m; 1.5 where none is known."""
    joints = candidate.bore.ring_station
    return float(np.median(np.diff(joints))) if len(joints) > 2 else 1.5


def _smooth_radius(candidate: Candidate, station: np.ndarray, angle: np.ndarray) -> np.ndarray:
    bore = candidate.bore
    row = np.clip(np.searchsorted(bore.station, station), 1, len(bore.station) - 1)
    step = (angle - bore.angle[0]) / (bore.angle[1] - bore.angle[0])
    low = np.floor(step).astype(int) % len(bore.angle)
    share, along = (
        step - np.floor(step),
        (station - bore.station[row - 1]) / (bore.station[row] - bore.station[row - 1]),
    )
    along = np.clip(along, 0.0, 1.0)
    high = (low + 1) % len(bore.angle)
    before, after = (bore.radius[r, low] * (1 - share) + bore.radius[r, high] * share for r in (row - 1, row))
    return (1 - along) * before + along * after


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
        along = np.abs(local[:, :1] - pocket["station"][None])
        turn = np.arctan2(local[:, 2:], local[:, 1:2]) - pocket["angle"][None]
        turn = np.abs((turn + np.pi) % (2.0 * np.pi) - np.pi)
        return ~((along < _NAIL_ALONG) & (turn < _NAIL_AROUND)).any(axis=1)

    return away


def _nearest_gap(station: np.ndarray, away: np.ndarray) -> np.ndarray:
    if not len(away):
        return np.full(len(station), np.inf)
    return np.min(np.abs(station[:, None] - away[None]), axis=1)


# Bodies that stand in the bore or close it.

EACH = 36.0  # m, the tunnels on which the points of the controls were set: a longer one gets its share
_WALL_THICKNESS = 0.3  # m thick
_DEBRIS_RADIUS = 0.3  # m, radius of a piece of debris
_PILLAR_SIZE = (0.5, 0.4)  # m along and across the tunnel


def place_box(
    candidate: Candidate, station: float, left: float, up: float, size: tuple[float, float, float]
) -> trimesh.Trimesh:
    """Return a box in the frame of the axis, m."""
    position, tangent, side, top = axis_of(candidate).frames(np.array([station]))
    placement = np.eye(4)
    placement[:3, :3] = np.column_stack([tangent[0], side[0], top[0]])
    placement[:3, 3] = position[0] + left * side[0] + up * top[0]
    return trimesh.creation.box(size, transform=placement)


def add_bodies(candidate: Candidate, parts: list[trimesh.Trimesh]) -> Candidate:
    """Puts closed bodies into the bore; the air volume loses theirs."""
    solid = candidate.solid.copy()
    solid.merge_vertices(digits_vertex=6)
    taken = trimesh.boolean.difference([solid, *parts], engine="manifold", check_volume=False)
    extra = [part for part in (candidate.extra, *parts) if len(part.faces)]
    return replace(candidate, solid=taken, extra=concatenate_meshes(extra))


def block_bore(candidate: Candidate, whole: bool) -> Candidate:
    """Puts a box of 1 m on the track in the middle of every `EACH` m, or a wall across the whole section."""
    bore, count = candidate.bore, _as_long_as(candidate)
    width, height = float(bore.width.max()), float(bore.height.max())
    low = -0.5 * float(np.median(bore.height))
    up, size = (0.0, (_WALL_THICKNESS, width + 0.5, height + 0.5)) if whole else (low + 0.6, (1.0, 1.0, 1.0))
    stations = candidate.length * (np.arange(count) + 0.5) / count
    return add_bodies(candidate, [place_box(candidate, float(station), 0.0, up, size) for station in stations])


def add_debris(candidate: Candidate, count: int, rng: np.random.Generator) -> Candidate:
    """Puts pieces of debris that float into the bore, so many to every `EACH` m."""
    count *= _as_long_as(candidate)
    station = rng.uniform(1.0, candidate.length - 1.0, count)
    local = np.column_stack([station, rng.uniform(-1.5, 1.5, count), rng.uniform(-1.0, 1.5, count)])
    parts = []
    for middle in axis_of(candidate).point(local):
        blob = trimesh.creation.icosphere(subdivisions=1, radius=_DEBRIS_RADIUS)
        blob.apply_translation(middle)
        parts.append(blob)
    return add_bodies(candidate, parts)


def _as_long_as(candidate: Candidate) -> int:
    """Returns how many times `EACH` m a tunnel is long, at least 1."""
    return max(1, round(candidate.length / EACH))


def add_pillars(candidate: Candidate, spacing: float) -> Candidate:
    """Puts pillars beside the track, floor to crown, as landmarks that are not there."""
    bore = candidate.bore
    stations = np.arange(0.5 * min(spacing, candidate.length), candidate.length - 1.0, spacing)
    aside, height = 0.36 * float(np.median(bore.width)), float(np.median(bore.height))
    size = (*_PILLAR_SIZE, height)
    return add_bodies(candidate, [place_box(candidate, s, aside, 0.0, size) for s in stations])


def close_mouth(candidate: Candidate) -> Candidate:
    """Puts an end wall where the tunnel goes on."""
    lining = candidate.lining.copy()
    lining.merge_vertices(digits_vertex=6)
    edges, count = np.unique(lining.edges_sorted, axis=0, return_counts=True)
    rim = edges[count == 1]
    middle = lining.vertices[rim].mean(axis=1)
    bore = candidate.bore
    near = np.abs((middle - bore.position[-1]) @ bore.tangent[-1]) < 0.3
    near &= np.linalg.norm(middle - bore.position[-1], axis=1) < 2.0 * float(bore.radius[-1].max())
    fan = np.column_stack([rim[near], np.full(int(near.sum()), len(lining.vertices))])
    vertices = np.vstack([lining.vertices, bore.position[-1]])
    inward = (
        np.einsum(
            "ij,j->i",
            np.cross(vertices[fan[:, 1]] - vertices[fan[:, 0]], vertices[fan[:, 2]] - vertices[fan[:, 0]]),
            bore.tangent[-1],
        )
        < 0
    )
    fan = np.where(inward[:, None], fan, fan[:, ::-1])
    return replace(candidate, lining=trimesh.Trimesh(vertices, np.vstack([lining.faces, fan]), process=False))
